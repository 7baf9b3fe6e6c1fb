"""Figures of layer 4 beyond the projection's speed: carving, features in voxels, their codes, and updates."""

from __future__ import annotations

import statistics
import tempfile
import time
from pathlib import Path
from typing import Any

from .figures import Figures, Line
from .folders import MODELS
from .machine_speed import copy_bytes_per_second
from .surface_gaussians import surface_gaussians

FEATURES, GAUSSIANS = 512, 200_000
VOXELS, WORDS = 1_000_000, 20


def measure_voxels() -> Figures:
    """Everything below, in one process."""
    return {
        "features": _features(),
        "insertion": _insertion(),
        "codes": _codes(),
        "update": _update(),
        "adaptive": _adaptive(),
        "asked": _asked(),
    }


def _features() -> Figures:
    """Gaussians a second with 512-dimensional features, from binning to normalized voxels. The floor is the time to
    read each feature from memory once."""
    import numpy as np

    from freeocc3d.occupancy import build, carve, splat

    def run(count: int) -> tuple[float, int]:
        gaussians = surface_gaussians(count)
        features = np.random.default_rng(0).normal(size=(count, FEATURES)).astype(np.float16)
        evidence = carve.DepthEvidence(np.zeros(3), 0.08, carve.Options())
        mark = time.perf_counter()
        bins = splat.bin_gaussians(gaussians, np.zeros(3), splat.Options())
        made = build.build_blocks(bins.packed, bins, gaussians, features, evidence, splat.Options(), carve.Options())
        return time.perf_counter() - mark, len(made.features)

    run(2000)  # compiles
    seconds, voxels = run(GAUSSIANS)
    floor = GAUSSIANS * FEATURES * 2 / copy_bytes_per_second()
    return {"gaussians_per_second": GAUSSIANS / seconds, "voxels": voxels, "seconds": seconds, "floor_seconds": floor}


def _insertion() -> Figures:
    """Depth images a second at 640 x 480 and 8 cm, in the built-in room: carving alone, carving with the surface in
    cells, and OctoMap's insertion of all their pixels and of every 16th."""
    import numpy as np

    from freeocc3d.capture import open_capture
    from freeocc3d.capture.base import Options
    from freeocc3d.core.transforms import back_project, transform
    from freeocc3d.core.types import PosedFrame
    from freeocc3d.gaussians.surface_cells import CellSums
    from freeocc3d.occupancy import carve

    room = open_capture("builtin:room", Options(), {"synthetic": {"width": 640, "height": 480}})
    poses = {index: pose for index in range(0, len(room), 6) if (pose := room.pose(index)) is not None}
    looks = [PosedFrame(room[index], pose, 0) for index, pose in poses.items()]

    def carving() -> None:
        evidence = carve.DepthEvidence(np.zeros(3), 0.08, carve.Options())
        for look in looks:
            evidence.add(look.frame, look.T_world_cam)

    def mapping() -> None:
        carving()
        cells = CellSums(0.04)
        for look in looks:
            cells.add_frame(look, 2, 0.05)

    found: Figures = {"frames": len(looks)}
    for name, work in (("carving", carving), ("mapping", mapping)):
        work()  # compiles
        mark = time.perf_counter()
        work()
        found[name] = len(looks) / (time.perf_counter() - mark)
    try:
        import pyoctomap
    except ImportError:
        return found
    for name, stride, few in (("octomap", 1, looks[::8]), ("octomap_every_16th", 4, looks)):
        tree = pyoctomap.OcTree(0.08)
        mark = time.perf_counter()
        for look in few:
            depth_m = look.frame.depth_m[::stride, ::stride]
            rows, columns = np.nonzero(depth_m)
            pixels = stride * np.stack((columns, rows), axis=1).astype(np.float64)
            points = back_project(pixels, depth_m[rows, columns].astype(np.float64), look.frame.intrinsics)
            tree.insertPointCloud(transform(look.T_world_cam, points), look.T_world_cam[:3, 3].copy())
        found[name] = len(few) / (time.perf_counter() - mark)
    return found


def _codes() -> Figures:
    """What coding loses: mean cosine to the features, and the share of voxels whose best of 20 words stays. Seconds of
    a million codes for 20 words."""
    import numpy as np

    from freeocc3d.language.feature_codec import Codec

    rng = np.random.default_rng(0)
    points = np.concatenate(
        [np.insert(rng.uniform(0, 4, (8000, 2)), axis, 4.0 * side, 1) for axis in range(3) for side in (0, 1)]
    )
    found: Figures = {}
    sets = {f"smooth over {length:g} m": _smooth(points, length) for length in (2.0, 1.0, 0.5)}
    if (MODELS / "clip_text_names.npz").is_file():
        names = np.load(MODELS / "clip_text_names.npz")["embeddings"].astype(np.float32)
        things = names[rng.choice(len(names), 40, replace=False)]
        mixed = rng.dirichlet(np.full(40, 0.05), len(points)) @ things
        sets["posteriors over 40 text embeddings"] = mixed / np.linalg.norm(mixed, axis=1, keepdims=True)
        words = np.concatenate((things[::4], names[:10]))
    for name, features in sets.items():
        codec = Codec.fit(features.astype(np.float16))
        codes = codec.encode(features)
        text = words if "text" in name else rng.normal(size=(WORDS, FEATURES)).astype(np.float32)
        same = (codec.cosines(codes, text).argmax(axis=1) == (features @ text.T).argmax(axis=1)).mean()
        cosine = (codec.decode(codes).astype(np.float32) * features).sum(axis=1).mean()
        found[name] = {"bytes": codec.code_bytes, "cosine": float(cosine), "same_word": float(same)}
    many = np.tile(codes, (VOXELS // len(codes) + 1, 1))[:VOXELS]
    codec.cosines(many, text)  # compiles
    times = []
    for _ in range(5):
        mark = time.perf_counter()
        codec.cosines(many, text)
        times.append(time.perf_counter() - mark)
    return {"sets": found, "million_voxels_seconds": statistics.median(times)}


def _smooth(points: Any, length: float) -> Any:
    """(P, 512) unit features that change over a length, meters."""
    import numpy as np

    rng = np.random.default_rng(0)
    values = np.cos(points @ (rng.normal(size=(3, FEATURES)) / length) + rng.uniform(0, 2 * np.pi, FEATURES))
    return (values / np.linalg.norm(values, axis=1, keepdims=True)).astype(np.float32)


def _update() -> Figures:
    """Seconds to add one keyframe's Gaussians to a map of a hundred, compared with a new map."""
    import numpy as np

    from freeocc3d.core.types import Frame, Intrinsics
    from freeocc3d.occupancy import carve, splat
    from freeocc3d.occupancy.incremental import IncrementalOccupancy

    camera = Intrinsics(64, 48, 60.0, 60.0, 31.5, 23.5)
    gaussians = surface_gaussians(100 * 2500)
    nothing = np.zeros((2500, 0), np.float16)

    def add(to: IncrementalOccupancy, number: int) -> None:
        own = gaussians[slice(2500 * number, 2500 * (number + 1))]
        depth = np.full((48, 64), 2.0, np.float32)
        T = np.eye(4)
        T[:3, 3] = own.means.mean(axis=0) - (0, 0, 2)
        to.add(number, Frame(number, 0.0, np.zeros((48, 64, 3), np.uint8), depth, camera), T, own, nothing)

    seconds = []
    for _ in range(3):
        growing = IncrementalOccupancy(splat.Options(), carve.Options())
        for number in range(99):
            add(growing, number)
        mark = time.perf_counter()
        growing.update()
        whole = time.perf_counter() - mark
        add(growing, 99)
        mark = time.perf_counter()
        growing.update()
        seconds.append((time.perf_counter() - mark, whole))
    one, whole = seconds[-1]
    return {"one_keyframe_seconds": one, "all_seconds": whole}


def _asked() -> Figures:
    """Seconds of a whole query, with regions, for 20 words on a million voxels of 40 kinds of things, whose names are
    contrast words. Every voxel reaches the threshold for every word, as with CLIP's raw similarities."""
    import numpy as np

    from freeocc3d.core.types import OCCUPIED, UNKNOWN, Occupancy
    from freeocc3d.language.encoders.base import TextEncoder, TextFeatures
    from freeocc3d.language.feature_codec import Codec, CodedFeatures
    from freeocc3d.query import word_query

    rng = np.random.default_rng(0)
    things = rng.normal(size=(40, FEATURES)).astype(np.float32) + 2.0  # similar to each other, as names are
    things /= np.linalg.norm(things, axis=1, keepdims=True)

    class Words(TextEncoder):
        threshold, temperature = 0.1, 0.01

        def encode_words(self, words: list[str]) -> TextFeatures:
            return TextFeatures(things[[int(word) for word in words]], tuple(words))

        def contrast_words(self) -> list[str]:
            return [str(k) for k in range(len(things))]

    edge = 128  # blocks along a floor's edge
    keys = np.stack((*np.divmod(np.arange(edge * edge), edge), np.zeros(edge * edge, int)), axis=1).astype(np.int32)
    layers = np.full((edge * edge, 8, 8, 8), UNKNOWN, np.uint8)
    layers[:, :, :, 3] = OCCUPIED
    state = layers.reshape(-1, 512)
    nothing = np.zeros(state.shape, np.uint16)
    floor = Occupancy(0.02, np.zeros(3), keys, np.ones(state.shape, np.float32), nothing, nothing, state)
    voxels = floor.occupied_voxels()
    kind = rng.integers(0, 40, (16, 16))[voxels[:, 0] // 64, voxels[:, 1] // 64]
    codec = Codec.fit(things[rng.integers(0, 40, 20000)] + 0.002 * rng.normal(size=(20000, FEATURES)))
    coded = CodedFeatures(codec, codec.encode(things)[kind])
    floor = floor.replace(features=coded, colors=np.zeros((len(kind), 3), np.uint8))
    words = [str(k) for k in range(WORDS)]
    times = []
    for _ in range(4):  # the first compiles
        mark = time.perf_counter()
        results = word_query.query(floor, Words(), words)
        times.append(time.perf_counter() - mark)
    found = {int(row) for result in results for region in result.regions for row in region.rows}
    return {"voxels": len(voxels), "seconds": statistics.median(times[1:]), "matched": len(found)}


def _adaptive() -> Figures:
    """The built-in room at 8 cm, with voxels down to 1 cm where they show more: seconds, voxels, bytes on disk, and the
    number of blocks if every surface had voxels of 1 cm."""
    import numpy as np

    from freeocc3d.core.types import OCCUPIED
    from freeocc3d.editing import adaptive_voxels
    from freeocc3d.pipeline import run as pipeline

    settings = {
        "capture": {"stride": 4},
        "tracking": {"backend": "known"},
        "fitting": {"passes": 0},
    }
    with tempfile.TemporaryDirectory() as folder:
        room = pipeline.reconstruct("builtin:room", Path(folder) / "room", settings)
        adaptive_voxels.refine_where_needed(room, 0.04, Path(folder) / "compiled")
        mark = time.perf_counter()
        fine = adaptive_voxels.refine_where_needed(room, 0.01, Path(folder) / "fine")
        seconds = time.perf_counter() - mark
        made = fine.occupancy
        occupied = np.count_nonzero(made.state == OCCUPIED, axis=1)
        area = occupied * 0.25**made.levels
        on_disk = (fine.path / "occupancy.npz").stat().st_size
        coarse_blocks = np.count_nonzero((room.occupancy.state == OCCUPIED).any(axis=1))
    return {
        "seconds": seconds,
        "voxels_by_level": np.bincount(made.levels, occupied).tolist(),
        "area_by_level": (np.bincount(made.levels, area) / area.sum()).tolist(),
        "blocks": len(made.keys),
        "blocks_everywhere": int(coarse_blocks * 8**made.deepest),
        "bytes_a_voxel": on_disk / int(occupied.sum()),
    }


def voxels_lines(figures: Figures) -> list[Line]:
    """Rows of a table: what, measured, asked."""
    parts = ("features", "insertion", "codes", "update", "adaptive", "asked")
    features, insertion, codes, update, several, asked = (figures[name] for name in parts)
    octomap = []
    if "octomap" in insertion:
        times = [insertion["mapping"] / insertion[name] for name in ("octomap", "octomap_every_16th")]
        octomap = [
            ("  OctoMap's insertion of all pixels", f"{insertion['octomap']:.1f} frames/s: 1/{times[0]:.0f}", "1/5"),
            ("  of every 16th pixel", f"{insertion['octomap_every_16th']:.0f} frames/s: 1/{times[1]:.1f}", "1/5"),
        ]
    lines: list[Line] = [
        ("Gaussians with 512 features to voxels", f"{features['gaussians_per_second'] / 1e6:.2f} million/s", "0.5"),
        (
            "  floor: reading their features",
            f"{1e3 * features['floor_seconds']:.0f} of {1e3 * features['seconds']:.0f} ms",
            "",
        ),
        ("depth images carved, 640 x 480, 8 cm", f"{insertion['carving']:.0f} frames/s", "30"),
        ("  with their surface in cells", f"{insertion['mapping']:.0f} frames/s", ""),
        *octomap,
        ("a million voxels scored for 20 words", f"{1e3 * codes['million_voxels_seconds']:.0f} ms", "100 ms"),
        ("  the whole answer, with 40 contrast words", f"{1e3 * asked['seconds']:.0f} ms", ""),
    ]
    for name, coded in codes["sets"].items():
        said = f"cosine {coded['cosine']:.4f}, same word {100 * coded['same_word']:.1f} %"
        lines.append((f"  {name}, {coded['bytes']} bytes", said, "0.98, 99 %"))
    milliseconds = [1e3 * update[name] for name in ("one_keyframe_seconds", "all_seconds")]
    lines.append(("one keyframe of a hundred updated; all", "{:.0f}; {:.0f} ms".format(*milliseconds), ""))
    shares = ", ".join(f"{100 * share:.0f}" for share in several["area_by_level"])
    lines += [
        ("the built-in room, 8 cm down to 1 cm where it shows more", f"{several['seconds']:.1f} s", ""),
        ("  % of the surface at 8, 4, 2, 1 cm", shares, ""),
        (
            "  blocks, and with 1 cm at every surface",
            f"{several['blocks']:,} of {several['blocks_everywhere']:,}",
            "",
        ),
        ("  bytes an occupied voxel on disk, free space included", f"{several['bytes_a_voxel']:.1f}", "72 + 16"),
    ]
    return lines
