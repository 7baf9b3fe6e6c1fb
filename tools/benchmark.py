#!/usr/bin/env python3
"""The project's figures on one capture, in one run, beside Open3D's dense SLAM on the same frames.

    python tools/benchmark.py [--capture FOLDER] [--frames N] [--only slam reconstruct score splat query] [--json]

Each part is measured in a process of its own, so that its threads, its memory peak and its imports are its own; this
process imports nothing but the standard library. One capture and one run: a figure moves by some per cent with what
else the machine does, and a ratio is only worth something when both of its sides come from the same run.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import platform
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

Figures = dict[str, Any]
Row = tuple[str, str, str]

DATA = Path(os.environ.get("FREEOCC3D_DATA") or Path(__file__).resolve().parents[2] / "shared" / "data")
COMMAND = [sys.executable, "-m", "freeocc3d.cli"]

PEER_VOXEL_SIZE_M = 0.01
PEER_DEPTH_MIN_M, PEER_DEPTH_MAX_M = 0.1, 3.0
PEER_DEPTH_DIFF_M = 0.07
PEER_TRUNCATION_VOXELS = 8.0
PEER_BLOCKS = 40_000
"""Open3D's examples/python/t_reconstruction_system/default_config.yml, but for the voxel size."""

UNITS_PER_METRE = 5000.0
"""Of the 16-bit depth that the peer is given: no rounding for captures in millimetres, 13 m at most."""

SPLAT_GAUSSIANS, SPLAT_VOXEL_SIZE_M = 2_000_000, 0.08
QUERY_WORD = "red"


@dataclass(frozen=True)
class Job:
    """What is measured. frames: the first N, None = all.  map: a map folder, built by ``reconstruct`` or given."""

    capture: Path
    frames: int | None
    map: Path


# Open3D's dense SLAM


def measure_slam(job: Job) -> Figures:
    """Decode, track, integrate and synthesise every frame; each step's seconds, and the trajectory's error."""
    import numpy as np
    import open3d as o3d

    capture = _open(job)
    first = capture[0]
    camera = o3d.core.Tensor(first.intrinsics.matrix)
    height, width = first.depth_m.shape
    device = o3d.core.Device("CPU:0")
    T_world_cam = o3d.core.Tensor(np.eye(4))
    model = o3d.t.pipelines.slam.Model(PEER_VOXEL_SIZE_M, 16, PEER_BLOCKS, T_world_cam, device)
    measured = o3d.t.pipelines.slam.Frame(height, width, camera, device)
    rendered = o3d.t.pipelines.slam.Frame(height, width, camera, device)

    seconds = _zeros("decode", "track", "integrate", "synthesise")
    poses = np.full((len(capture), 4, 4), np.nan)
    failures = 0
    frames = range(len(capture))[: job.frames]
    for index in frames:
        mark = time.perf_counter()
        frame = capture[index]
        depth = np.rint(frame.depth_m * UNITS_PER_METRE).astype(np.uint16)
        measured.set_data_from_image("depth", o3d.t.geometry.Image(depth))
        measured.set_data_from_image("color", o3d.t.geometry.Image(frame.color))
        mark = _lap(seconds, "decode", mark)
        if index > 0:
            try:
                result = model.track_frame_to_model(
                    measured, rendered, UNITS_PER_METRE, PEER_DEPTH_MAX_M, PEER_DEPTH_DIFF_M
                )
                T_world_cam = T_world_cam @ result.transformation
            except RuntimeError:
                failures += 1  # the last pose is kept
        mark = _lap(seconds, "track", mark)
        poses[index] = T_world_cam.numpy()
        model.update_frame_pose(index, T_world_cam)
        model.integrate(measured, UNITS_PER_METRE, PEER_DEPTH_MAX_M, PEER_TRUNCATION_VOXELS)
        mark = _lap(seconds, "integrate", mark)
        model.synthesize_model_frame(
            rendered, UNITS_PER_METRE, PEER_DEPTH_MIN_M, PEER_DEPTH_MAX_M, PEER_TRUNCATION_VOXELS, False
        )
        _lap(seconds, "synthesise", mark)
    return {
        "frames": len(frames),
        "seconds": seconds,
        "seconds_without_decoding": sum(seconds.values()) - seconds["decode"],
        "tracking_failures": failures,
        "ate_rmse_m": _peer_error(capture, poses),
    }


def _peer_error(capture: Any, T_world_cam: Any) -> float:
    """ATE of poses (N, 4, 4), NaN for frames that were not used, after SE(3) alignment."""
    import numpy as np

    from freeocc3d.evaluation.align import align_trajectory, true_poses
    from freeocc3d.types import Trajectory

    n = len(capture)
    trajectory = Trajectory(
        capture.timestamps, T_world_cam, np.zeros(0, np.int32), np.full(n, "tracked"), np.ones(n, np.float32)
    )
    return align_trajectory(trajectory, true_poses(capture), with_scale=False).ate_rmse_m


# Reconstruction, from the capture on disk to the map on disk


def measure_reconstruct(job: Job) -> Figures:
    """Wall time and peak memory of the command, and its stages as the map's report states them."""
    command = [*COMMAND, "reconstruct", str(job.capture), "-o", str(job.map), "--overwrite"]
    if job.frames is not None:
        command += ["--set", f"capture.stop={job.frames}"]
    seconds, peak_bytes, _ = _timed_command(command)
    _, _, printed = _timed_command([*COMMAND, "info", str(job.map), "--json"])
    facts = json.loads(printed)
    return {
        "seconds": seconds,
        "peak_memory_bytes": peak_bytes,
        "stages": facts["seconds"],
        "frames_with_pose": facts["frames_with_pose"],
        "gaussians": facts["gaussians"],
        "voxels": facts["voxels"],
        "map_bytes": sum(facts["bytes"].values()),
    }


# Scores against the truth


def measure_score(job: Job) -> Figures:
    """ATE of the map's trajectory, and IoU where the capture brings a ground truth."""
    error = map_ate(job.map)
    truth = job.capture / "ground_truth.npz"
    return {**error, **(map_iou(job.map, truth) if truth.is_file() else {})}


def map_ate(map_path: Path) -> Figures:
    """Error of the map's trajectory against the poses of the capture that it was made of, after SE(3) alignment."""
    alignment = _map_alignment(map_path)
    return {"ate_rmse_m": alignment.ate_rmse_m, "frames_matched": alignment.frames_matched}


def map_iou(map_path: Path, ground_truth_path: Path) -> Figures:
    """IoU, precision and recall of a map inside the mask of a ground truth, on the ground truth's lattice."""
    from freeocc3d.evaluation.iou import load_ground_truth, occupancy_iou
    from freeocc3d.evaluation.score import occupied_on_lattice
    from freeocc3d.store import load_map

    truth = load_ground_truth(ground_truth_path)
    occupied = occupied_on_lattice(
        load_map(map_path), _map_alignment(map_path), truth.origin, truth.shape, truth.voxel_size
    )
    score = occupancy_iou(truth.labels, occupied)
    return {"iou": score.iou, "precision": score.precision, "recall": score.recall}


def _map_alignment(map_path: Path) -> Any:
    from freeocc3d.capture import open_capture
    from freeocc3d.evaluation.align import align_trajectory, true_poses
    from freeocc3d.store import load_map

    loaded = load_map(map_path)
    capture = open_capture(loaded.manifest["capture"]["path"])
    return align_trajectory(loaded.trajectory, true_poses(capture), with_scale=False)


# Gaussians to voxels


def measure_splat(job: Job) -> Figures:
    """Gaussians a second through layer 4's projection, beside what the machine needs for its arithmetic alone."""
    import numpy as np

    from freeocc3d.occupancy import splat
    from freeocc3d.occupancy.grid import unpack

    cutoff, origin = splat.Options().cutoff, np.zeros(3)

    def project(gaussians: Any, seconds: dict[str, float]) -> Any:
        mark = time.perf_counter()
        bins = splat.bin_gaussians(gaussians, origin, SPLAT_VOXEL_SIZE_M, cutoff)
        mark = _lap(seconds, "sort into blocks", mark)
        splat.probability(bins, unpack(bins.packed))
        _lap(seconds, "evaluate", mark)
        return bins

    project(surface_gaussians(1000), _zeros("sort into blocks", "evaluate"))  # compiles
    gaussians = surface_gaussians(SPLAT_GAUSSIANS)
    runs = []
    for _ in range(5):
        runs.append(_zeros("sort into blocks", "evaluate"))
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

    from freeocc3d.geometry import quats_to_rotations
    from freeocc3d.types import Gaussians

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


# Queries


def measure_query(job: Job) -> Figures:
    """A word asked from a cold start, five times, and in a loaded map, twenty times."""
    cold = [_timed_command([*COMMAND, "query", str(job.map), QUERY_WORD, "--json"])[0] for _ in range(5)]
    loaded = _in_own_process("_loaded_query", job)
    return {"cold_seconds": statistics.median(cold), **loaded}


def measure_loaded_query(job: Job) -> Figures:
    """Seconds to load a map with its first answer, and the median of those after it."""
    from freeocc3d.store import load_map

    mark = time.perf_counter()
    loaded = load_map(job.map)
    result = loaded.query(QUERY_WORD)
    first = time.perf_counter() - mark
    times = []
    for _ in range(20):
        mark = time.perf_counter()
        loaded.query(QUERY_WORD)
        times.append(time.perf_counter() - mark)
    return {"first_seconds": first, "loaded_seconds": statistics.median(times), "regions": len(result.regions)}


# Processes


PARTS: dict[str, Callable[[Job], Figures]] = {
    "slam": measure_slam,
    "reconstruct": measure_reconstruct,
    "score": measure_score,
    "splat": measure_splat,
    "query": measure_query,
}
"""In the order in which they run."""

INSIDE: dict[str, Callable[[Job], Figures]] = {**PARTS, "_loaded_query": measure_loaded_query}
"""What ``--inside`` can name: all that is measured in a process of its own."""

COMMANDS_ONLY = {"reconstruct", "query"}
"""Parts that only start other processes."""

NEED_A_MAP = {"score", "query"}


class PartFailed(Exception):
    """A part could not be measured; the message is one sentence."""


def measure(part: str, job: Job) -> Figures:
    """One part's figures, or {"error": sentence}."""
    if part in NEED_A_MAP and not (job.map / "map.yaml").is_file():
        return {"error": f"there is no map {job.map}: run the part 'reconstruct' too, or name a map with --map"}
    try:
        return PARTS[part](job) if part in COMMANDS_ONLY else _in_own_process(part, job)
    except PartFailed as error:
        return {"error": str(error)}


def _in_own_process(part: str, job: Job) -> Figures:
    """``INSIDE[part](job)`` in a fresh interpreter, with that process's wall time and peak memory."""
    command = [sys.executable, __file__, "--inside", part, "--capture", str(job.capture), "--map", str(job.map)]
    if job.frames is not None:
        command += ["--frames", str(job.frames)]
    seconds, peak_bytes, printed = _timed_command(command)
    figures: Figures = json.loads(printed.splitlines()[-1])  # libraries print to stdout too
    return {**figures, "process_seconds": seconds, "process_peak_memory_bytes": peak_bytes}


def _timed_command(command: list[str]) -> tuple[float, int, str]:
    """Wall seconds, peak resident bytes (of the largest of its processes) and stdout. Raises PartFailed."""
    with tempfile.TemporaryFile("w+") as out, tempfile.TemporaryFile("w+") as err:
        mark = time.perf_counter()
        process = subprocess.Popen(command, stdout=out, stderr=err)
        _, status, usage = os.wait4(process.pid, 0)
        seconds = time.perf_counter() - mark
        process.returncode = os.waitstatus_to_exitcode(status)
        out.seek(0)
        err.seek(0)
        if process.returncode != 0:
            said = err.read().strip().splitlines() or ["nothing"]
            raise PartFailed(f"'{' '.join(command[1:5])} …' ended with {process.returncode} and said: {said[-1]}")
        return seconds, usage.ru_maxrss * 1024, out.read()


def _open(job: Job) -> Any:
    from freeocc3d.capture import open_capture

    return open_capture(job.capture)


def _zeros(*steps: str) -> dict[str, float]:
    return dict.fromkeys(steps, 0.0)


def _lap(seconds: dict[str, float], step: str, mark: float) -> float:
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


# The table


def table(results: dict[str, Figures]) -> list[Row]:
    """Rows of what was measured, and what is asked for."""
    writers = {
        "slam": slam_rows,
        "reconstruct": reconstruct_rows,
        "score": score_rows,
        "splat": splat_rows,
        "query": query_rows,
    }
    rows: list[Row] = []
    for part, figures in results.items():
        rows += writers[part](figures, results) if "error" not in figures else [(part, "failed, see below", "")]
    return rows


def slam_rows(figures: Figures, results: dict[str, Figures]) -> list[Row]:
    per_frame = {step: 1e3 * value / figures["frames"] for step, value in figures["seconds"].items()}
    steps = ", ".join(f"{step} {value:.0f}" for step, value in per_frame.items())
    without, decode = figures["seconds_without_decoding"], figures["seconds"]["decode"]
    return [
        ("Open3D dense SLAM, wall time", f"{without:.1f} s ({without + decode:.1f} s with decoding)", ""),
        ("  per frame", f"{steps} ms", ""),
        ("  peak memory", f"{figures['process_peak_memory_bytes'] / 1e9:.2f} GB", ""),
        ("  tracking failures", f"{figures['tracking_failures']} of {figures['frames']} frames", ""),
        ("  ATE after SE(3) alignment", f"{100 * figures['ate_rmse_m']:.2f} cm", ""),
    ]


def reconstruct_rows(figures: Figures, results: dict[str, Figures]) -> list[Row]:
    stages = ", ".join(f"{stage} {value:.1f}" for stage, value in figures["stages"].items())
    rows = [("freeocc3d reconstruct, wall time", f"{figures['seconds']:.1f} s", "")]
    if "seconds" in (peer := results.get("slam", {})):
        without = peer["seconds_without_decoding"]
        ratio, decoded = figures["seconds"] / without, figures["seconds"] / (without + peer["seconds"]["decode"])
        rows.append(("  over dense SLAM's", f"{ratio:.2f} ({decoded:.2f} of it with its decoding)", "at most 0.5"))
    return [
        *rows,
        ("  stages", f"{stages} s", ""),
        ("  peak memory", f"{figures['peak_memory_bytes'] / 1e9:.2f} GB", "at most 4 GB"),
        ("  gaussians, occupied voxels", f"{figures['gaussians']:,}, {figures['voxels']['occupied']:,}", ""),
        ("  map on disk", f"{figures['map_bytes'] / 1e6:.1f} MB", ""),
    ]


def score_rows(figures: Figures, results: dict[str, Figures]) -> list[Row]:
    peer = results.get("slam", {}).get("ate_rmse_m")
    asked = f"as it is; dense SLAM's {100 * peer:.2f} cm" if peer is not None else "as it is"
    rows = [
        ("map, ATE after SE(3) alignment", f"{100 * figures['ate_rmse_m']:.2f} cm", asked),
        ("  frames with a true and an own pose", f"{figures['frames_matched']}", ""),
    ]
    if "iou" in figures:
        shares = ", ".join(f"{name} {100 * figures[name]:.1f}" for name in ("precision", "recall"))
        rows.append(
            (
                "map, IoU",
                f"{100 * figures['iou']:.1f} ({shares})",
                "as it is; 65.2 on the kitchen from dense SLAM's poses, TSDF",
            )
        )
    return rows


def splat_rows(figures: Figures, results: dict[str, Figures]) -> list[Row]:
    floor = figures["floor_seconds"]
    steps = ", ".join(f"{step} {1e3 * value:.0f}" for step, value in figures["steps"].items())
    return [
        ("Gaussians to voxels", f"{figures['gaussians_per_second'] / 1e6:.2f} million/s", "at least 2"),
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


def query_rows(figures: Figures, results: dict[str, Figures]) -> list[Row]:
    return [
        ("query from a cold start", f"{figures['cold_seconds']:.2f} s", "under 3 s"),
        ("query in a loaded map", f"{1e3 * figures['loaded_seconds']:.1f} ms", "under 50 ms"),
        ("  loading with the first answer", f"{figures['first_seconds']:.2f} s", ""),
    ]


def format_table(rows: list[Row]) -> str:
    """Aligned columns under their names."""
    lines = [("what", "measured", "asked"), *rows]
    widths = [max(len(line[column]) for line in lines) for column in range(2)]
    return "\n".join(f"{a:<{widths[0]}} | {b:<{widths[1]}} | {c}".rstrip(" |") for a, b, c in lines)


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--capture", type=Path, default=DATA / "7scenes-kitchen", help="folder of a scan with poses")
    parser.add_argument("--frames", type=int, metavar="N", help="the first N frames only")
    parser.add_argument("--only", nargs="+", choices=PARTS, default=list(PARTS), metavar="PART", help=", ".join(PARTS))
    parser.add_argument("--map", type=Path, help="keep the map here, or use the one that is here (default: temporary)")
    parser.add_argument("--json", action="store_true", help="print one JSON document and nothing else")
    parser.add_argument("--inside", choices=INSIDE, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if not given.capture.is_dir():
        parser.error(f"there is no capture {given.capture}: name one with --capture")
    if given.frames is not None and given.frames < 3:
        parser.error("--frames needs at least 3, for fewer cannot be aligned")
    return given


def main() -> None:
    given = arguments()
    if given.inside:
        print(json.dumps(INSIDE[given.inside](Job(given.capture, given.frames, given.map))))
        return
    with tempfile.TemporaryDirectory(prefix="freeocc3d-benchmark-") as temporary:
        job = Job(given.capture.resolve(), given.frames, (given.map or Path(temporary) / "map").resolve())
        results: dict[str, Figures] = {}
        for part in PARTS:
            if part in given.only:
                print(f"measuring: {part}", file=sys.stderr)
                results[part] = measure(part, job)
    machine = {"processor": platform.machine(), "cores": os.cpu_count(), "python": platform.python_version()}
    if given.json:
        print(json.dumps({"capture": str(job.capture), "frames": job.frames, "machine": machine, **results}))
    else:
        print(f"{job.capture}, {f'first {job.frames}' if job.frames else 'all'} frames, {machine['cores']} cores")
        print(format_table(table(results)))
    failed = {part: figures["error"] for part, figures in results.items() if "error" in figures}
    for part, sentence in failed.items():
        print(f"{part} failed: {sentence}", file=sys.stderr)
    sys.exit(bool(failed))


if __name__ == "__main__":
    main()
