"""Speed of layer 4's projection and of queries, beside what the machine needs at least."""

from __future__ import annotations

import math
import os
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

Figures = dict[str, Any]
Line = tuple[str, str, str]

SPLAT_GAUSSIANS, SPLAT_VOXEL_SIZE_M = 2_000_000, 0.08
QUERY_WORD = "red"


def measure_splat() -> Figures:
    """Gaussians a second through layer 4's projection, beside what the machine needs for its arithmetic alone."""
    import numpy as np

    from freeocc3d.core.voxel_keys import unpack_voxels
    from freeocc3d.occupancy import splat

    options, origin = splat.Options(voxel_size=SPLAT_VOXEL_SIZE_M), np.zeros(3)

    def project(gaussians: Any, seconds: dict[str, float]) -> Any:
        mark = time.perf_counter()
        bins = splat.bin_gaussians(gaussians, origin, options)
        mark = lap(seconds, "sort into blocks", mark)
        splat.compute_probability(bins, unpack_voxels(bins.packed))
        lap(seconds, "evaluate", mark)
        return bins

    project(surface_gaussians(1000), zeros("sort into blocks", "evaluate"))  # compiles
    gaussians = surface_gaussians(SPLAT_GAUSSIANS)
    runs = []
    for _ in range(5):
        runs.append(zeros("sort into blocks", "evaluate"))
        bins = project(gaussians, runs[-1])
    steps = sorted(runs, key=lambda run: sum(run.values()))[len(runs) // 2]  # the median run
    seconds = sum(steps.values())
    visits = int((bins.hi - bins.lo + 1).clip(min=0).astype(np.int64).prod(axis=1).sum())
    bytes_touched = sum(getattr(gaussians, name).nbytes for name in ("means", "scales", "quats_wxyz", "opacities"))
    bytes_touched += len(bins.packed) * 512 * 4
    copy_rate, exp_rate = copy_bytes_per_second(), exps_per_second()
    return {
        "gaussians": len(gaussians),
        "blocks": len(bins.packed),
        "seconds": seconds,
        "steps": steps,
        "gaussians_per_second": len(gaussians) / seconds,
        "voxel_visits": visits,
        "copy_bytes_per_second": copy_rate,
        "exps_per_second": exp_rate,
        "floor_seconds": {"memory": bytes_touched / copy_rate, "exp": visits / exp_rate},
    }


def surface_gaussians(count: int) -> Any:
    """Gaussians as layer 2 makes them at 8 cm, one per 4 cm of surface, on square patches of 2 m in random places and
    directions; in the order of the patches, as neighbours in a map are neighbours in memory."""
    import numpy as np

    from freeocc3d.core.transforms import quats_to_rotations
    from freeocc3d.core.types import Gaussians

    rng = np.random.default_rng(0)
    patch = np.arange(count) // 2500
    patches = patch[-1] + 1
    quats = rng.normal(size=(patches, 4))
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    edge = 2.0 * math.sqrt(patches)  # of a building two metres high that holds two metres of patch for each of floor
    corners = rng.uniform((0, 0, 0), (edge, edge, 2.0), (patches, 3))
    on_patch = np.concatenate((rng.uniform(0, 2.0, (count, 2)), rng.normal(0, 0.005, (count, 1))), axis=1)
    means = corners[patch] + np.einsum("nij,nj->ni", quats_to_rotations(quats)[patch], on_patch)
    scales = 0.025 * rng.uniform((0.8, 0.8, 0.3), (1.2, 1.2, 1.0), (count, 3))
    return Gaussians(
        means=means.astype(np.float32),
        scales=scales.astype(np.float32),
        quats_wxyz=quats[patch].astype(np.float32),
        opacities=np.full(count, 0.9, np.float32),
        colors=np.zeros((count, 3), np.uint8),
        anchor_keyframe=np.zeros(count, np.int32),
        anchor_cam=means.astype(np.float32),
    )


def copy_bytes_per_second() -> float:
    """Bytes read and written a second by a NumPy copy of 256 MB on one thread."""
    import numpy as np

    source = np.ones(256_000_000, np.uint8)
    target = np.zeros_like(source)
    return 2 * source.nbytes / _fastest(lambda: np.copyto(target, source))


def exps_per_second() -> float:
    """float32 exponentials a second, NumPy's vectorised one on one thread times the number of processors."""
    import numpy as np

    values = -np.random.default_rng(0).random(1 << 20, np.float32)
    out = np.empty_like(values)
    return len(values) * (os.cpu_count() or 1) / _fastest(lambda: np.exp(values, out=out))


def measure_query(map_path: Path) -> Figures:
    """Seconds to load a map with its first answer, and the median of those after it."""
    from freeocc3d.storage.store import load_map

    mark = time.perf_counter()
    loaded = load_map(map_path)
    result = loaded.query(QUERY_WORD)
    first = time.perf_counter() - mark
    times = []
    for _ in range(20):
        mark = time.perf_counter()
        loaded.query(QUERY_WORD)
        times.append(time.perf_counter() - mark)
    return {"first_seconds": first, "loaded_seconds": statistics.median(times), "regions": len(result.regions)}


def zeros(*steps: str) -> dict[str, float]:
    return dict.fromkeys(steps, 0.0)


def lap(seconds: dict[str, float], step: str, mark: float) -> float:
    now = time.perf_counter()
    seconds[step] += now - mark
    return now


def _fastest(work: Callable[[], object], repeats: int = 5) -> float:
    times = []
    for _ in range(repeats):
        mark = time.perf_counter()
        work()
        times.append(time.perf_counter() - mark)
    return min(times)


def splat_lines(figures: Figures) -> list[Line]:
    """What was measured, and what is asked for."""
    floor = figures["floor_seconds"]
    steps = ", ".join(f"{step} {1e3 * value:.0f}" for step, value in figures["steps"].items())
    return [
        ("Gaussians to voxels", f"{figures['gaussians_per_second'] / 1e6:.2f} million/s", "at least 5"),
        ("  2 million at 8 cm", f"{1e3 * figures['seconds']:.0f} ms: {steps}", ""),
        (
            "  floor: their exponentials alone",
            f"{1e3 * floor['exp']:.1f} ms at {figures['exps_per_second'] / 1e9:.1f} billion/s",
            "",
        ),
        (
            "  floor: their memory alone",
            f"{1e3 * floor['memory']:.1f} ms at {figures['copy_bytes_per_second'] / 1e9:.1f} GB/s",
            "",
        ),
    ]


def query_lines(figures: Figures) -> list[Line]:
    """What was measured, and what is asked for."""
    return [
        ("query from a cold start", f"{figures['cold_seconds']:.2f} s", "≤ 1.5 s"),
        ("query in a loaded map", f"{1e3 * figures['loaded_seconds']:.1f} ms", "≤ 30 ms"),
        ("  loading with the first answer", f"{figures['first_seconds']:.2f} s", ""),
    ]
