#!/usr/bin/env python3
"""Maps, ablations and the strongest peers that run here, on the same captures in one run: every figure that is claimed.

    python tools/benchmark.py [--suite quick|full] [-o FOLDER] [--compare OLD/results.json]
    python tools/benchmark.py --captures SCAN --variants rgbd dense_slam_tsdf ours_octomap

Rows are captures x variants. A variant is an ablation of ``configs/ablations`` (mapped and scored by the command), a
peer of ``tools/peers.py``, or a kernel. Each is measured in a process of its own, so that its threads, its memory peak
and its imports are its own; this process imports little. Times a frame are over all frames of the capture, although the
peers that make voxels use every second one. A time moves by some per cent with what else the machine does: compare
ratios of one run.
"""

from __future__ import annotations

import argparse
import itertools
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

import absent_words
import encoders
import exporters
import held_out
import kernels
import language
import mono
import present_words
import rendering
import stereo
import variants
import voxels

Figures = dict[str, Any]

DATA = Path(os.environ.get("FREEOCC3D_DATA") or Path(__file__).resolve().parents[2] / "shared" / "data")
COMMAND = [sys.executable, "-m", "freeocc3d.cli"]
LAYER_1_STAGES = ("calibration", "tracking", "refinement")
OURS = "rgbd"
"""The variant whose poses the peers ``ours_*`` are given, and which queries are asked of."""

TRUE_POSES = "rgbd_true_poses"

PEERS = {
    "dense_slam_tsdf": "Open3D dense SLAM (1 cm), its poses, TSDF",
    "dense_slam_back_projection": "Open3D dense SLAM (1 cm), its poses, points counted",
    "ours_tsdf": "our poses, TSDF",
    "ours_octomap": "our poses, OctoMap",
    "true_poses_back_projection": "the capture's own poses, points counted (the ceiling)",
    "true_poses_tsdf": "the capture's own poses, TSDF (the ceiling)",
}
"""``POSES_OCCUPANCY``: where the poses come from, and what makes voxels of them."""

UNFITTED = "rgbd_no_fitting"
MONO = "mono"

KERNELS = ("splat", "voxels", "query", "rasterizer", "encoders", "lifting")
CLASSES = "rgbd_true_poses_closed_set"
LAYER_3 = {
    "fusion": f"class images with regions flipped at random, fused in the map of {CLASSES}",
}
LAYER_1 = {
    "stress": "layer 1 on altered captures: what is reached, what is lost, and whether that is told",
    "glued": "layer 1 on two captures as if they were one, which must stay two submaps",
    "lengths": "layer 1 on the first 250, 500 and 1000 frames: seconds, and bytes of a keyframe",
}

SUITES = {
    "quick": (("house/bedroom",), (OURS, "rgbd_true_poses", "rgbd_true_poses_closed_set", *PEERS, *KERNELS, "lengths")),
    "full": (("7scenes-kitchen", "house/bedroom", "house/living"), None),
}
"""Captures of the data folder, and variants (None = all)."""


@dataclass(frozen=True)
class Job:
    """One capture's runs. frames: the first N, None = all.  folder: for maps and trajectories."""

    capture: Path
    frames: int | None
    folder: Path

    @property
    def name(self) -> str:
        """What rows call the capture."""
        inside = self.capture.is_relative_to(DATA.resolve())
        return str(self.capture.relative_to(DATA.resolve())) if inside else self.capture.name

    def poses(self, source: str) -> Path:
        """Where a run leaves its poses for others."""
        return self.folder / f"{source}.npz"


class PartFailed(Exception):
    """A part could not be measured; the message is one sentence."""


# Maps


def map_row(job: Job, variant: variants.Variant) -> Figures:
    """Map the capture as the variant says, and score it. Raises PartFailed."""
    if variant.lacking:
        raise PartFailed(variant.lacking)
    folder = job.folder / variant.name
    command = [*COMMAND, "reconstruct", str(job.capture), "-o", str(folder), "--config", str(variant.path)]
    if job.frames is not None:
        command += ["--set", f"capture.stop={job.frames}"]
    if variant.colour_alone:
        command += ["--set", f"capture.stride={mono.stride(_frames(job.capture))}"]
    seconds, peak_bytes, _ = _timed_command(command)
    facts = json.loads(_timed_command([*COMMAND, "info", str(folder), "--json"])[2])
    used = facts["frames"] - facts["frame_status"].get("unused", 0)
    own = sum(facts["seconds"].values())
    return {
        **_inside("score_map", map=str(folder), capture=str(job.capture), out=str(job.poses(variant.name))),
        "frames": used,
        "frames_with_pose": facts["frames_with_pose"],
        "wall_seconds": seconds,
        "ms_per_frame": {stage: 1e3 * value / used for stage, value in facts["seconds"].items()},
        "frames_per_second": used / own,
        "peak_memory_bytes": peak_bytes,
        "map_bytes": sum(facts["bytes"].values()),
        "gaussians": facts["gaussians"],
        "voxels": facts["voxels"],
    }


def _frames(capture: Path) -> int:
    from freeocc3d.capture import open_capture

    return len(open_capture(capture))


def score_map(map: str, capture: str, out: str) -> Figures:
    """ATE and RPE against the capture's poses; IoU and mIoU where it brings a ground truth. Leaves the aligned poses of
    all frames in ``out``."""
    from freeocc3d.evaluation import scoring
    from freeocc3d.evaluation.ground_truth import load_ground_truth
    from freeocc3d.evaluation.trajectory_errors import measure_trajectory_errors
    from freeocc3d.storage.store import load_map
    from freeocc3d.tracking.trajectory_alignment import align_trajectories, read_true_poses, select_estimated_poses

    loaded = load_map(map)
    estimated, true = select_estimated_poses(loaded.trajectory), read_true_poses(scoring.reopen_capture(loaded))
    how = "se3" if loaded.metric else "sim3"
    alignment = align_trajectories(estimated, true, how)
    errors = measure_trajectory_errors(estimated, true, alignment)
    _save_poses(Path(out), alignment.poses(loaded.trajectory.T_world_cam), errors, loaded.up @ alignment.rotation.T)
    figures: Figures = {"ate_rmse_m": errors.ate_rmse_m, "trajectory": errors.to_json()}
    figures["held_out"] = held_out.held_out(loaded)
    truth_path = Path(capture) / "ground_truth.npz"
    if truth_path.is_file():
        truth = load_ground_truth(truth_path)
        classes = scoring.collect_common_classes([truth])
        scene = scoring.score_map(loaded, truth, classes, true, how)
        scored = scoring.Evaluation((scene,), classes.classes, how)
        figures |= _scores(scored.scores, scored.miou(), scored.classes_in_miou)
    return figures


def _scores(scores: Any, miou: float | None, classes: Any) -> Figures:
    return {
        "iou": scores.iou,
        "precision": scores.precision,
        "recall": scores.recall,
        "miou": miou,
        "classes_in_miou": list(classes) if miou is not None else [],
    }


def _save_poses(path: Path, T_true_cam: Any, errors: Any, up: Any) -> None:
    import numpy as np

    np.savez(path, poses=T_true_cam, true=errors.true, aligned=errors.aligned, errors=errors.errors_m, up=up)


# Peers


def dense_slam_run(job: Job) -> Figures:
    """Open3D's dense SLAM on the frames: its seconds a step; it leaves its poses. Raises PartFailed."""
    figures = _inside("dense_slam", capture=str(job.capture), frames=job.frames, out=str(job.poses("dense_slam")))
    steps = figures["seconds"]
    return {**figures, "seconds_without_decoding": sum(steps.values()) - steps["decode"]}


def dense_slam(capture: str, frames: int | None, out: str) -> Figures:
    """Track every frame and leave the aligned poses in ``out``."""
    import numpy as np
    import peers

    from freeocc3d.capture import open_capture
    from freeocc3d.evaluation.trajectory_errors import measure_trajectory_errors
    from freeocc3d.tracking.trajectory_alignment import Poses, align_trajectories, read_true_poses

    opened = open_capture(capture)
    used = range(len(opened))[:frames]
    T_world_cam, seconds, failures = peers.dense_slam(opened, used)
    has_pose = np.isfinite(T_world_cam).all(axis=(1, 2))
    estimated, true = Poses(opened.timestamps[has_pose], T_world_cam[has_pose]), read_true_poses(opened)
    alignment = align_trajectories(estimated, true)
    errors = measure_trajectory_errors(estimated, true, alignment)
    first = T_world_cam[np.flatnonzero(has_pose)[0]]
    _save_poses(Path(out), alignment.poses(T_world_cam), errors, alignment.rotation @ -first[:3, 1])
    return {
        "frames": len(used),
        "seconds": seconds,
        "tracking_failures": failures,
        "ate_rmse_m": errors.ate_rmse_m,
        "trajectory": errors.to_json(),
    }


def peer_row(job: Job, name: str, slam: Figures | None) -> Figures:
    """One peer's occupancy. slam: of dense SLAM, whose poses ``dense_slam_*`` use. Raises PartFailed."""
    source = next(s for s in ("dense_slam", "ours", "true_poses") if name.startswith(s))
    poses = {"dense_slam": job.poses("dense_slam"), "ours": job.poses(OURS), "true_poses": None}[source]
    if source == "dense_slam" and slam is not None and "error" in slam:
        raise PartFailed(slam["error"])
    if poses is not None and not poses.is_file():
        raise PartFailed(f"there are no poses of {source}: name the variant that makes them, too")
    truth = job.capture / "ground_truth.npz"
    if not truth.is_file():
        raise PartFailed(f"{job.name} has no ground_truth.npz to score against")
    figures = _inside(
        "occupancy",
        kind=name.removeprefix(f"{source}_"),
        capture=str(job.capture),
        frames=job.frames,
        poses=None if poses is None else str(poses),
        truth=str(truth),
    )
    frames = figures["frames"]
    steps = figures.pop("seconds")
    if source == "dense_slam" and slam is not None:
        steps = {**slam["seconds"], "voxels": sum(steps.values())}
        figures |= {"ate_rmse_m": slam["ate_rmse_m"], "trajectory": slam["trajectory"]}
        figures["peak_memory_bytes"] = max(figures["peak_memory_bytes"], slam["peak_memory_bytes"])
    return {
        **figures,
        "wall_seconds": sum(steps.values()),
        "ms_per_frame": {step: 1e3 * value / frames for step, value in steps.items()},
        "frames_per_second": frames / sum(steps.values()),
    }


def occupancy(kind: str, capture: str, frames: int | None, poses: str | None, truth: str) -> Figures:
    """Score what a peer calls occupied, given the capture's poses (``poses`` None) or those in a file, which are in the
    true frame already."""
    import numpy as np
    import peers

    from freeocc3d.capture import open_capture
    from freeocc3d.evaluation.confusion import Prediction, Scores, count_confusion
    from freeocc3d.evaluation.ground_truth import load_ground_truth
    from freeocc3d.tracking.trajectory_alignment import read_true_poses

    opened, expected = open_capture(capture), load_ground_truth(truth)
    if poses is None:
        stated = read_true_poses(opened)
        T_true_cam = np.full((len(opened), 4, 4), np.nan)
        T_true_cam[np.searchsorted(opened.timestamps, stated.timestamps)] = stated.T_world_cam
    else:
        T_true_cam = np.load(poses)["poses"]
    used = range(len(opened))[:frames]
    T_true_cam[len(used) :] = np.nan
    lattice = peers.Lattice(expected.origin, expected.shape, expected.voxel_size)
    figures: Figures = {}
    if kind == "tsdf":
        area, seconds = peers.surface_area(opened, T_true_cam, lattice, every=2)
        occupied, figures["surface_m2"] = area >= peers.TSDF_MIN_AREA_M2, float(area.sum())
    else:
        run = {"back_projection": peers.back_projected_occupied, "octomap": peers.octomap_occupied}[kind]
        occupied, seconds = run(opened, T_true_cam, lattice)
    names = expected.classes[1:]
    matrix = count_confusion(expected.labels, Prediction(occupied), expected.masks()["label"], len(names))
    return {**figures, **_scores(Scores(matrix, names), None, ()), "seconds": seconds, "frames": len(used)}


# Kernels


def kernel(name: str, asked_map: Path | None) -> Figures:
    """Speed of the projection, or of queries in a map. Raises PartFailed."""
    if name in ("splat", "voxels", "rasterizer", "encoders", "lifting"):
        return _inside(name)
    if asked_map is None or not (asked_map / "map.yaml").is_file():
        raise PartFailed(f"there is no map to ask: name the variant {OURS}, too")
    command = [*COMMAND, "query", str(asked_map), kernels.QUERY_WORD, "--json"]
    cold = [_timed_command(command)[0] for _ in range(5)]
    return {"cold_seconds": statistics.median(cold), **_inside("query", map_path=str(asked_map))}


def _stress() -> Any:
    import stress

    return stress


# Layer 3


def fusion(job: Job) -> Figures:
    """What fusion makes of class images of which some are wrong. Raises PartFailed."""
    path = job.folder / CLASSES
    if not (path / "map.yaml").is_file():
        raise PartFailed(f"there is no map with class images: name the variant {CLASSES}, too")
    return _inside("fusion", map_path=str(path))


# Processes


def _asked_lines(table: list[tuple[str, str, str]]) -> list[str]:
    """A table of what was measured and what is asked for; nothing of nothing."""
    lines = [f"| {' | '.join(line)} |" for line in table]
    return ["", "| what | measured | asked |", "|---|---|---|", *lines] if lines else []


def _export_lines(rows: list[Figures]) -> list[str]:
    """A table for each capture."""
    lines = []
    for row in rows:
        if "error" in row:
            lines.append(f"\nexports of {row['capture']}: not available, {row['error']}")
        else:
            lines += [f"\n{row['capture']}:", *_asked_lines(exporters.exports_lines(row))]
    return lines


@dataclass(frozen=True)
class Each:
    """What is measured of each capture in a process of its own.  measure: of the capture's path.  lines: of the report
    about all captures' figures."""

    title: str
    measure: Callable[[str], Figures]
    lines: Callable[[list[Figures]], list[str]]


EACH = {
    "absent_words": Each(
        "names of things that are not there: how often a region is returned all the same",
        absent_words.measure_words,
        lambda rows: _asked_lines(absent_words.words_lines(rows)),
    ),
    "present_words": Each(
        "names of the classes that are there: how much of each is found, and how soon",
        present_words.measure_present,
        lambda rows: _asked_lines(present_words.present_lines(rows)),
    ),
    "exports": Each(
        "every exporter at 4 cm: seconds, memory, bytes; the plan for robots beside the truth's",
        exporters.measure_exports,
        _export_lines,
    ),
    "mono": Each(
        "poses from colour alone: placed images, ATE and seconds, beside pycolmap's pipeline at its defaults",
        mono.measure_mono,
        mono.mono_lines,
    ),
    "stereo_depth": Each(
        "depth by multi-view stereo from colour at true poses, against the capture's depth",
        stereo.measure_stereo,
        stereo.stereo_lines,
    ),
}

INSIDE = {
    "score_map": score_map,
    "dense_slam": dense_slam,
    "occupancy": occupancy,
    "stress": lambda **given: _stress().stress(**given),
    "stress_names": lambda: {"names": list(_stress().sequences(100))},
    "glued": lambda **given: _stress().glued(**given),
    "lengths": lambda **given: _stress().lengths(**given),
    "warm_up": lambda **given: _stress().warm_up(**given),
    "splat": lambda: kernels.measure_splat(),
    "voxels": lambda: voxels.measure_voxels(),
    "rasterizer": lambda: rendering.measure_rasterizer(),
    "encoders": lambda: encoders.measure_encoders(),
    "query": lambda map_path: kernels.measure_query(Path(map_path)),
    "lifting": lambda: language.measure_lifting(),
    "fusion": lambda map_path: language.measure_fusion(Path(map_path)),
    **{name: part.measure for name, part in EACH.items()},
}
"""What is measured in a process of its own."""


def _inside(part: str, **arguments: Any) -> Figures:
    """``INSIDE[part](**arguments)`` in a fresh interpreter, with that process's peak memory. Raises PartFailed."""
    command = [sys.executable, __file__, "--inside", part, json.dumps(arguments)]
    _, peak_bytes, printed = _timed_command(command)
    figures: Figures = json.loads(printed.splitlines()[-1])  # libraries print to stdout too
    return {**figures, "peak_memory_bytes": peak_bytes}


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
            said = err.read().strip().splitlines() or [f"it ended with {process.returncode}"]
            raise PartFailed(said[-1].removeprefix("freeocc3d: "))
        return seconds, usage.ru_maxrss * 1024, out.read()


# The run


def run(captures: list[Path], names: list[str], frames: int | None, folder: Path) -> Figures:
    """All rows, and the kernels' figures."""
    known = variants.all_variants()
    rows: list[Figures] = []
    layer_3: Figures = {}
    asked_map: Path | None = None
    _tried("nothing yet, everything is compiled first", lambda: _inside("warm_up", capture=str(captures[0].resolve())))
    for number, capture in enumerate(captures):
        job = Job(capture.resolve(), frames, folder / str(number))
        job.folder.mkdir(parents=True)
        slam = None
        if any(name.startswith("dense_slam") for name in names):
            slam = _tried(f"{job.name}: dense SLAM", lambda job=job: dense_slam_run(job))
        for name in names:
            if name in known:
                row = _tried(f"{job.name}: {name}", lambda job=job, name=name: map_row(job, known[name]))
                title, table = known[name].title, known[name].table
            elif name in PEERS:
                row = _tried(f"{job.name}: {name}", lambda job=job, name=name, slam=slam: peer_row(job, name, slam))
                title, table = PEERS[name], "Peers"
            else:
                continue
            if slam is not None and "error" not in slam and "wall_seconds" in row:
                row["wall_over_dense_slam"] = row["wall_seconds"] / slam["seconds_without_decoding"]
            why = row.pop("error", "")
            rows.append(
                {"capture": job.name, "variant": name, "title": title, "table": table, "available": not why,
                 "why": why, **row}
            )  # fmt: skip
        for row in rows:
            if slam is not None and "error" not in slam and row["capture"] == job.name and "ms_per_frame" in row:
                stages = {stage: 1e-3 * row["frames"] * value for stage, value in row["ms_per_frame"].items()}
                for what, names_of in (("layer_1", LAYER_1_STAGES), ("fitting", ("fitting",))):
                    own = sum(stages.get(stage, 0.0) for stage in names_of)
                    if own:
                        row[f"{what}_over_dense_slam"] = own / slam["seconds_without_decoding"]
        if "fusion" in names:
            layer_3[job.name] = _tried(f"{job.name}: fusion", lambda job=job: fusion(job))
        if asked_map is None and (job.folder / OURS).is_dir():
            asked_map = job.folder / OURS
    measured = {name: _tried(name, lambda name=name: kernel(name, asked_map)) for name in KERNELS if name in names}
    layer_1 = measure_layer_1([capture.resolve() for capture in captures], names)
    each = {name: [_of_capture(capture, name) for capture in captures] for name in EACH if name in names}
    machine = {"processor": platform.machine(), "cores": os.cpu_count(), "python": platform.python_version()}
    return {
        "machine": machine, "frames": frames, "rows": rows, "kernels": measured, "layer_1": layer_1, "layer_3": layer_3,
        "each": each,
    }  # fmt: skip


def _of_capture(capture: Path, part: str) -> Figures:
    name = Job(capture.resolve(), None, capture).name
    return {"capture": name, **_tried(f"{name}: {part}", lambda: _inside(part, capture=str(capture.resolve())))}


def measure_layer_1(captures: list[Path], names: list[str]) -> Figures:
    """Rows of "stress" (glued ones among them), and "lengths" of the longest capture."""
    named = {capture: Job(capture, None, capture).name for capture in captures}
    figures: Figures = {}
    rows: list[Figures] = []
    if "stress" in names:
        for capture in captures:
            for sequence in stress_names():
                row = _tried(
                    f"{named[capture]}: {sequence}",
                    lambda capture=capture, sequence=sequence: _inside("stress", capture=str(capture), name=sequence),
                )
                rows.append({"capture": named[capture], "sequence": sequence, **row})
    if "glued" in names:
        for first, second in itertools.pairwise(captures):
            both = f"{named[first]} + {named[second]}"
            row = _tried(
                f"glued: {both}",
                lambda first=first, second=second: _inside("glued", captures=[str(first), str(second)]),
            )
            rows.append({"capture": both, "sequence": "glued", **row})
    if rows:
        figures["stress"] = rows
    if "lengths" in names:
        measured = [
            _tried(f"{named[capture]}: lengths", lambda capture=capture: _inside("lengths", capture=str(capture)))
            for capture in captures
        ]
        figures["lengths"] = [
            {"capture": named[capture], **row}
            for capture, found in zip(captures, measured, strict=True)
            for row in found.get("rows", [])
        ]
    return figures


def stress_names() -> tuple[str, ...]:
    """Of the altered sequences."""
    return tuple(_inside("stress_names")["names"])


def _tried(what: str, measure: Any) -> Figures:
    """The figures, or {"error": sentence}."""
    print(f"measuring: {what}", file=sys.stderr, flush=True)
    try:
        return dict(measure())
    except PartFailed as error:
        return {"error": str(error)}


# Tables


COLUMNS = (
    "capture", "variant", "ATE cm", "IoU", "mIoU", "precision", "recall", "PSNR dB", "depth cm", "Gaussians",
    "ms/frame", "fps", "memory GB", "map MB", "x dense SLAM", "layer 1 x", "fitting x", "what",
)  # fmt: skip


def markdown(results: Figures) -> str:
    """A table of all rows, and the kernels' lines. What was not measured is a dash, never a zero."""
    lines = [" | ".join(("", *COLUMNS, "")).strip(), "|" + "---|" * len(COLUMNS)]
    for row in results["rows"]:
        cells = (
            row["capture"],
            row["variant"],
            _number(row.get("ate_rmse_m"), 100, 2),
            *(_number(row.get(name), 100, 1) for name in ("iou", "miou", "precision", "recall")),
            _number((row.get("held_out") or {}).get("psnr_measured"), 1, 2),
            _number((row.get("held_out") or {}).get("depth_l1_m"), 100, 1),
            _number(row.get("gaussians"), 1, 0),
            _number(sum(row["ms_per_frame"].values()) if "ms_per_frame" in row else None, 1, 1),
            _number(row.get("frames_per_second"), 1, 1),
            _number(row.get("peak_memory_bytes"), 1e-9, 2),
            _number(row.get("map_bytes"), 1e-6, 1),
            _number(row.get("wall_over_dense_slam"), 1, 2),
            _number(row.get("layer_1_over_dense_slam"), 1, 2),
            _number(row.get("fitting_over_dense_slam"), 1, 2),
            row["title"] if row["available"] else f"{row['title']}: **not available**, {row['why']}",
        )
        lines.append(f"| {' | '.join(cells)} |")
    lines += [f"\nmIoU of {capture}: over {classes}" for capture, classes in _class_lists(results).items()]
    writers = {
        "splat": kernels.splat_lines,
        "voxels": voxels.voxels_lines,
        "query": kernels.query_lines,
        "rasterizer": rendering.rasterizer_lines,
        "encoders": encoders.encoders_lines,
        "lifting": language.lifting_lines,
    }
    for name, write in writers.items():
        figures = results["kernels"].get(name)
        if figures is not None and "error" in figures:
            lines.append(f"\n{name}: not available, {figures['error']}")
        elif figures is not None:
            lines += _asked_lines(write(figures))
    return "\n".join(
        [
            *lines,
            *_layer_1_lines(results.get("layer_1") or {}),
            *[line for name, found in (results.get("each") or {}).items() for line in EACH[name].lines(found)],
            *language.fusion_lines(results.get("layer_3") or {}),
            *_pose_lines(results["rows"]),
            *_mono_lines(results["rows"]),
            *_fit_lines(results["rows"]),
        ]
    )


def _layer_1_lines(figures: Figures) -> list[str]:
    """Tables of "stress" and "lengths"."""
    lines = []
    for part, table_of in (("stress", "stress_table"), ("lengths", "length_table")):
        if rows := figures.get(part):
            table = getattr(_stress(), table_of)(rows)
            lines += ["", *(f"| {' | '.join(line)} |" for line in (table[0], ["---"] * len(table[0]), *table[1:]))]
    return lines


def _pose_lines(rows: list[Figures]) -> list[str]:
    """IoU with estimated poses over IoU with the capture's, where both were measured."""
    iou = {(row["capture"], row["variant"]): row.get("iou") for row in rows}
    lines = []
    for capture in dict.fromkeys(row["capture"] for row in rows):
        ours, given = iou.get((capture, OURS)), iou.get((capture, TRUE_POSES))
        if ours and given:
            lines.append(f"\n{capture}: IoU with our poses is {ours / given:.3f} of that with the capture's poses")
    return lines


def _mono_lines(rows: list[Figures]) -> list[str]:
    """IoU from colour alone over IoU with depth, where both were measured."""
    iou = {(row["capture"], row["variant"]): row.get("iou") for row in rows}
    lines = []
    for capture in dict.fromkeys(row["capture"] for row in rows):
        alone, with_depth = iou.get((capture, MONO)), iou.get((capture, OURS))
        if alone and with_depth:
            lines.append(
                f"\n{capture}: IoU from colour alone is {alone / with_depth:.3f} of that with depth (0.6 asked)"
            )
    return lines


def _fit_lines(rows: list[Figures]) -> list[str]:
    """What fitting gains on held-out frames and in IoU, and how densely Gaussians lie."""
    found = {(row["capture"], row["variant"]): row for row in rows}
    lines = []
    for capture in dict.fromkeys(row["capture"] for row in rows):
        ours, plain = found.get((capture, OURS), {}), found.get((capture, UNFITTED), {})
        if ours.get("held_out") and plain.get("held_out"):
            was, now = plain["held_out"], ours["held_out"]
            gain, everywhere = (now[name] - was[name] for name in ("psnr_measured", "psnr"))
            iou = 100 * ((ours.get("iou") or 0) - (plain.get("iou") or 0))
            lines.append(
                f"\n{capture}: on {now['frames']} held-out frames fitting changes PSNR by {gain:+.2f} dB where depth "
                f"is measured ({everywhere:+.2f} over all pixels), depth errors from {100 * was['depth_l1_m']:.1f} to "
                f"{100 * now['depth_l1_m']:.1f} cm, and IoU by {iou:+.2f}"
            )
        surface = found.get((capture, "true_poses_tsdf"), {}).get("surface_m2")
        if surface and ours.get("gaussians"):
            lines.append(f"\n{capture}: {ours['gaussians'] / surface:.0f} Gaussians per square metre of surface")
    return lines


def _class_lists(results: Figures) -> dict[str, str]:
    lists = {row["capture"]: row["classes_in_miou"] for row in results["rows"] if row.get("classes_in_miou")}
    return {capture: f"{len(names)} classes: {', '.join(names)}" for capture, names in lists.items()}


def _number(value: float | None, factor: float, digits: int) -> str:
    return "–" if value is None or not math.isfinite(value) else f"{factor * value:.{digits}f}"


COMPARED = {
    "ate_rmse_m": ("ATE cm", 100, 0.05),
    "iou": ("IoU", 100, 0.1),
    "miou": ("mIoU", 100, 0.1),
    "precision": ("precision", 100, 0.1),
    "recall": ("recall", 100, 0.1),
    "wall_over_dense_slam": ("x dense SLAM", 1, 0.05),
    "layer_1_over_dense_slam": ("layer 1 x dense SLAM", 1, 0.03),
    "frames_per_second": ("fps", 1, 1.0),
    "peak_memory_bytes": ("memory GB", 1e-9, 0.05),
    "map_bytes": ("map MB", 1e-6, 0.1),
}
"""Figure -> (name, factor, what counts as a move)."""


def moved(old: Figures, new: Figures) -> str:
    """What differs between two runs' rows by more than its threshold; rows that only one of them has are named."""
    before = {(row["capture"], row["variant"]): row for row in old["rows"]}
    after = {(row["capture"], row["variant"]): row for row in new["rows"]}
    lines = []
    for key, row in after.items():
        where = " ".join(key)
        if key not in before:
            lines.append(f"{where}: new")
            continue
        for name, (title, factor, threshold) in COMPARED.items():
            was, now = before[key].get(name), row.get(name)
            if (was is None) != (now is None):
                lines.append(f"{where}: {title} {_number(was, factor, 2)} -> {_number(now, factor, 2)}")
            elif was is not None and now is not None and abs(factor * (now - was)) > threshold:
                lines.append(f"{where}: {title} {factor * was:.2f} -> {factor * now:.2f} ({factor * (now - was):+.2f})")
    lines += [f"{' '.join(key)}: not measured this time" for key in before if key not in after]
    return "\n".join(lines) or "nothing moved"


def draw(results: Figures, folder: Path, out: Path) -> None:
    """Plots: IoU bars, time by stage, trajectories from above with their errors."""
    import numpy as np
    import plots

    plots.iou_bars(out / "iou.png", results["rows"])
    plots.stage_bars(out / "stages.png", results["rows"])
    for number, capture in enumerate(dict.fromkeys(row["capture"] for row in results["rows"])):
        for source in (OURS, "dense_slam"):
            path = folder / str(number) / f"{source}.npz"
            if path.is_file():
                saved = np.load(path)
                name = f"trajectory_{capture.replace('/', '_')}_{source}.png"
                plots.trajectory_plot(
                    out / name, f"{capture}, {source}", saved["true"], saved["aligned"], saved["errors"], saved["up"]
                )


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--suite", choices=SUITES, default="quick", help="quick: minutes; full: all captures, variants")
    parser.add_argument("--captures", nargs="+", type=Path, metavar="SCAN", help="folders of scans with poses")
    parser.add_argument("--variants", nargs="+", metavar="NAME", help="ablations, peers or kernels; --list names them")
    parser.add_argument("--list", action="store_true", help="list what --variants can name, and what runs")
    parser.add_argument("--frames", type=int, metavar="N", help="the first N frames only")
    parser.add_argument(
        "-o", "--output", type=Path, metavar="FOLDER", help="write results.json, table.md and plots here"
    )
    parser.add_argument("--compare", type=Path, metavar="OLD", help="an earlier results.json: print what moved")
    parser.add_argument("--json", action="store_true", help="print one JSON document and nothing else")
    parser.add_argument("--inside", nargs=2, help=argparse.SUPPRESS)
    given = parser.parse_args()
    captures, names = SUITES[given.suite]
    given.captures = given.captures or [DATA / name for name in captures]
    known = [*variants.names(), *PEERS, *KERNELS, *LAYER_1, *LAYER_3, *EACH]
    given.variants = given.variants or list(names or known)
    if unknown := [name for name in given.variants if name not in known]:
        parser.error(f"unknown variants {', '.join(unknown)}: --list names all")
    if not given.inside and not given.list:
        for capture in given.captures:
            if not capture.is_dir():
                parser.error(f"there is no capture {capture}: name one with --captures")
    if given.frames is not None and given.frames < 3:
        parser.error("--frames needs at least 3, for fewer cannot be aligned")
    return given


def main() -> None:
    given = arguments()
    if given.inside:
        part, values = given.inside
        print(json.dumps(INSIDE[part](**json.loads(values))))
        return
    if given.list:
        for name, variant in variants.all_variants().items():
            print(f"{name:<38} {variant.title}" + (f": not available, {variant.lacking}" if variant.lacking else ""))
        for name, title in PEERS.items():
            print(f"{name:<38} {title}")
        for name, title in (LAYER_1 | LAYER_3 | {name: part.title for name, part in EACH.items()}).items():
            print(f"{name:<38} {title}")
        print(f"{', '.join(KERNELS):<38} speed of the projection, of voxels, queries, rendering and encoders")
        return
    old = json.loads(given.compare.read_text(encoding="utf-8")) if given.compare else None
    with tempfile.TemporaryDirectory(prefix="freeocc3d-benchmark-") as temporary:
        results = run(given.captures, given.variants, given.frames, Path(temporary))
        if given.output is not None:
            given.output.mkdir(parents=True, exist_ok=True)
            (given.output / "results.json").write_text(json.dumps(results, indent=1), encoding="utf-8")
            (given.output / "table.md").write_text(markdown(results) + "\n", encoding="utf-8")
            draw(results, Path(temporary), given.output)
    print(json.dumps(results) if given.json else markdown(results))
    if old is not None:
        print(f"\nmoved since {given.compare}:\n{moved(old, results)}", file=sys.stderr if given.json else sys.stdout)


if __name__ == "__main__":
    main()
