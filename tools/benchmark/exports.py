"""Every exporter on a map of a capture: seconds, peak memory and bytes.

Each runs as ``freeocc3d export`` in its own process, with start and loading of the map included. The ``.bt`` is
compared with OctoMap's own file of the same voxels, and the plan for robots with the plan of the truth. This process
maps nothing itself, and loads no voxels before all exports are done: a process begins with the memory peak of the
process that starts it.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

from msgspec import structs

from .figures import Figures, Line
from .plan_agreement import measure_plan, plan_lines
from .processes import COMMAND, run_timed

SECONDS, BYTES = 10, 2e9
"""What is asked of each export at 4 cm."""

BT = "octomap .bt"
EXPORTS: dict[str, tuple[str, str, dict[str, str]]] = {
    "ply": ("map.ply", "ply", {}),
    "ply, points": ("points.ply", "ply", {"form": "points", "frame": "gravity"}),
    "npz": ("map.npz", "npz", {"frame": "gravity"}),
    "npz, sparse": ("sparse.npz", "npz", {"form": "sparse"}),
    BT: ("map.bt", "octomap", {}),
    "octomap .ot": ("map.ot", "octomap", {}),
    "octomap, ColorOcTree": ("colors.ot", "octomap", {"color": "true"}),
    "nav2": ("map.yaml", "nav2", {}),
    "nav2, with costs of three words": ("costs.yaml", "nav2", {"avoid": "WORDS"}),
    "esdf .npz": ("esdf.npz", "esdf", {}),
    "esdf .vdb": ("esdf.vdb", "esdf", {}),
    "glb": ("map.glb", "glb", {}),
    "geojson": ("map.geojson", "geojson", {}),
    "gaussians": ("gaussians.ply", "gaussians", {}),
    "poses, colmap": ("colmap", "poses", {}),
    "poses, nerfstudio": ("nerfstudio", "poses", {"form": "nerfstudio"}),
}
"""The exports: file, format, options."""


def measure_exports(capture: str) -> Figures:
    """Map a capture at 4 cm with its own poses, and class images if it has them, and export it."""
    encoder = "labels" if (Path(capture) / "semantic_class").is_dir() else "color"
    settings = (
        "tracking.backend=known",
        "fitting.passes=0",
        "occupancy.voxel_size=0.04",
        f"language.encoder={encoder}",
    )
    with tempfile.TemporaryDirectory() as folder:
        made = str(Path(folder) / "map")
        run_timed([*COMMAND, "reconstruct", capture, "-o", made, *(f"--set={setting}" for setting in settings)])
        return measure_map_exports(made)


def measure_map_exports(map_path: str) -> Figures:
    """Seconds, peak bytes and bytes written of each of EXPORTS; OctoMap's own file; the plan's agreement."""
    from freeocc3d.query.scan_map import load_map

    loaded = load_map(map_path)
    words = ", ".join(f"{word}{how}" for word, how in zip(loaded.vocabulary, (":40%", ":0.5", ":1:60%"), strict=False))
    with tempfile.TemporaryDirectory() as folder:
        rows = {}
        for name, (file, kind, options) in EXPORTS.items():
            path = Path(folder) / name / file
            path.parent.mkdir()
            chosen = [f"--set={key}={words if value == 'WORDS' else value}" for key, value in options.items()]
            command = [*COMMAND, "export", map_path, "--format", kind, "-o", str(path), *chosen]
            seconds, peak, _ = run_timed(command)
            size = sum(each.stat().st_size for each in path.parent.rglob("*") if each.is_file())
            rows[name] = {"seconds": seconds, "peak_memory_bytes": peak, "bytes": size}
        own = Path(folder) / "own.bt"
        octomap = {}
        if _octomaps_own(loaded, own):
            bodies = [path.read_bytes().split(b"data\n", 1)[1] for path in (Path(folder) / BT / "map.bt", own)]
            octomap = {"bt_bytes": len(bodies[0]), "octomaps_bytes": len(bodies[1]), "same": bodies[0] == bodies[1]}
    counts = structs.asdict(loaded.manifest.counts.voxels)
    figures = {"voxel_size_m": loaded.occupancy.finest, "voxels": counts, "exports": rows, "octomap": octomap}
    truth = Path(loaded.manifest.capture.path) / "ground_truth.npz"
    return {**figures, **({"plan": measure_plan(map_path)} if truth.is_file() else {})}


def _octomaps_own(made: Any, path: Path) -> bool:
    """Have OctoMap write the voxels, pruned. False where it is not installed."""
    import numpy as np

    try:
        import pyoctomap
    except ImportError:
        return False
    from freeocc3d.core.types import FREE, OCCUPIED
    from freeocc3d.export.export_frames import place_voxels

    there = place_voxels(made, "gravity", origin=np.zeros(3)).occupancy
    tree = pyoctomap.OcTree(there.voxel_size)
    for state in (FREE, OCCUPIED):
        for center in there.centers(there.voxels(state)):
            tree.updateNode(center, state == OCCUPIED, lazy_eval=True)
    tree.updateInnerOccupancy()
    return bool(tree.writeBinary(str(path)))


def exports_lines(figures: Figures) -> list[Line]:
    """Rows of a table: what, measured, asked."""
    size, occupied = figures["voxel_size_m"], figures["voxels"]["occupied"]
    lines: list[Line] = [(f"exports of {occupied:,} occupied voxels of {100 * size:g} cm", "", "")]
    asked = f"{SECONDS} s, {BYTES / 1e9:g} GB"
    for name, row in figures["exports"].items():
        measured = f"{row['seconds']:.1f} s, {row['peak_memory_bytes'] / 1e9:.2f} GB, {row['bytes'] / 1e6:.2f} MB"
        lines.append((f"  {name}", measured, asked))
    if octomap := figures["octomap"]:
        same = "the same bytes" if octomap["same"] else "other bytes"
        measured = f"{octomap['bt_bytes']:,} of {octomap['octomaps_bytes']:,} bytes, {same}"
        lines.append(("  .bt and OctoMap's own", measured, "no larger"))
    return [*lines, *(plan_lines(figures["plan"]) if "plan" in figures else [])]
