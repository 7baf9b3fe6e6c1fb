"""Layer 1 alone, on altered captures: frames dropped, darkened, reversed, glued; and on captures of growing length."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from freeocc3d.capture import open_capture, select_frames
from freeocc3d.capture.base import Capture, Options
from freeocc3d.capture.focal_correction import Reregistered
from freeocc3d.capture.read_ahead import read_ahead
from freeocc3d.core.errors import FreeOccError
from freeocc3d.core.types import Frame, Trajectory
from freeocc3d.evaluation.trajectory_errors import measure_trajectory_errors
from freeocc3d.tracking.rgbd import focal_calibration
from freeocc3d.tracking.rgbd.measured_pairs import measure_pairs
from freeocc3d.tracking.trackers import rgbd
from freeocc3d.tracking.trajectory_alignment import Poses, align_trajectories

from .figures import Figures, tabulate

Change = Callable[[int, Frame], Frame]

LENGTHS = (250, 500, 1000)
_GAP, _BLACK = 30, 20


@dataclass(frozen=True)
class Shown:
    """Frames of a capture in the order of tracking, and how each is altered."""

    frames: Sequence[int]
    change: Change = lambda position, frame: frame
    lost: frozenset[int] = frozenset()
    """Positions of frames that show nothing, which tracking must report as lost."""


def sequences(count: int) -> dict[str, Shown]:
    """The altered sequences by name, for a capture of ``count`` frames."""
    middle = count // 2
    every, black = range(count), frozenset(range(middle, middle + _BLACK))
    return {
        "full": Shown(every),
        "every 3rd frame": Shown(range(0, count, 3)),
        "30 frames cut out": Shown([i for i in every if not middle <= i < middle + _GAP]),
        "20 black frames": Shown(every, lambda n, frame: _colored(frame, 0.0) if n in black else frame),
        "20 frames without anything": Shown(every, lambda n, frame: _blank(frame) if n in black else frame, black),
        "half the depth missing": Shown(every, _holes),
        "left half of the depth missing": Shown(every, _left_missing),
        "brightness x 0.5 to 1.6": Shown(every, lambda n, frame: _colored(frame, 1.05 + 0.55 * np.sin(n / 15.4))),
        "reversed": Shown(range(count - 1, -1, -1)),
        "there and back": Shown([*every, *range(count - 2, -1, -1)]),
    }


def _colored(frame: Frame, gain: float) -> Frame:
    return replace(frame, color=np.clip(frame.color * gain, 0, 255).astype(np.uint8))


def _blank(frame: Frame) -> Frame:
    return replace(frame, color=np.zeros_like(frame.color), depth_m=np.zeros_like(frame.depth_m))


def _holes(position: int, frame: Frame) -> Frame:
    """Without depth in a random half of the squares of 16 pixels."""
    height, width = frame.depth_m.shape
    missing = np.random.default_rng(position).random((height // 16 + 1, width // 16 + 1)) < 0.5
    holes = np.kron(missing, np.ones((16, 16), bool))[:height, :width]
    return replace(frame, depth_m=np.where(holes, np.float32(0), frame.depth_m))


def _left_missing(position: int, frame: Frame) -> Frame:
    depth = frame.depth_m.copy()
    depth[:, : depth.shape[1] // 2] = 0
    return replace(frame, depth_m=depth)


def opened(capture: str) -> Capture:
    """A capture as the pipeline gives it to layer 1, which does not read its poses."""
    plain = open_capture(capture, Options())
    ratio = focal_calibration.estimate_color_focal(measure_pairs(plain, select_frames(plain)))
    return plain if ratio == 1 else Reregistered(plain, ratio)


def tracked(captures: Iterable[tuple[Capture, Shown]]) -> tuple[rgbd.RgbdTracker, Trajectory, float]:
    """The tracker after all sequences, one after the other, its trajectory by position, and its seconds."""
    tracker = rgbd.RgbdTracker(rgbd.Options())
    position, seconds = 0, 0.0
    for capture, sequence in captures:
        for _, frame in read_ahead(capture, sequence.frames):
            assert isinstance(frame, Frame), frame
            changed = replace(sequence.change(position, frame), index=position)
            mark = time.perf_counter()
            tracker.track(changed)
            seconds += time.perf_counter() - mark
            position += 1
    mark = time.perf_counter()
    tracker.optimize()
    seconds += time.perf_counter() - mark
    return tracker, tracker.trajectory(np.arange(position, dtype=np.float64)), seconds


def measure_sequence(capture: str, name: str) -> Figures:
    """One sequence of a capture: ATE against its poses, and the status of its frames."""
    scan = opened(capture)
    sequence = sequences(len(scan))[name]
    tracker, trajectory, seconds = tracked([(scan, sequence)])
    stated = [scan.pose(index) for index in sequence.frames]
    known = {n: pose for n, pose in enumerate(stated) if pose is not None and trajectory.has_pose[n]}
    rows = list(known)
    estimated = Poses(trajectory.timestamps[rows], trajectory.T_world_cam[rows])
    true = Poses(trajectory.timestamps[rows], np.stack(list(known.values())))
    errors = measure_trajectory_errors(estimated, true, align_trajectories(estimated, true))
    lost = set(np.flatnonzero(trajectory.status == "lost").tolist())
    figures = {
        "ate_rmse_m": errors.ate_rmse_m,
        "ate_max_m": float(errors.errors_m.max()),
        "frames": len(sequence.frames),
        "expected_lost": len(sequence.lost),
        "missed_losses": len(sequence.lost - lost),
        "other_losses": len(lost - sequence.lost),
        "seconds": seconds,
        **_pieces(tracker, trajectory),
    }
    if name == "there and back":
        ends = trajectory.T_world_cam[[0, -1], :3, 3]
        figures["gap_m"] = float(np.linalg.norm(ends[1] - ends[0]))
    return figures


def measure_stress(capture: str) -> Figures:
    """Every sequence of a capture, as "cases"."""
    cases = []
    for name in sequences(0):
        try:
            cases.append({"sequence": name, **measure_sequence(capture, name)})
        except FreeOccError as error:
            cases.append({"sequence": name, "error": str(error)})
    return {"cases": cases}


def measure_glued(captures: list[str]) -> Figures:
    """Two captures of different places as one: the frames of the submaps."""
    scans = [opened(capture) for capture in captures]
    tracker, trajectory, seconds = tracked([(scan, Shown(range(len(scan)))) for scan in scans])
    expected = [list(range(len(scans[0]))), list(range(len(scans[0]), sum(map(len, scans))))]
    found = [submap.frames.tolist() for submap in tracker.submaps()]
    return {
        "sequence": "glued",
        "frames": len(trajectory),
        "seconds": seconds,
        "apart_as_they_are": sorted(found) == expected,
        **_pieces(tracker, trajectory),
    }


def measure_lengths(capture: str) -> Figures:
    """Seconds of layer 1 on the first 250, 500, 1000 frames, and bytes in memory per keyframe."""
    rows = []
    for count in LENGTHS:
        mark = time.perf_counter()
        plain = open_capture(capture, Options(stop=count))
        if len(plain) < count:
            break
        ratio = focal_calibration.estimate_color_focal(measure_pairs(plain, select_frames(plain)))
        calibrated = time.perf_counter() - mark
        scan = plain if ratio == 1 else Reregistered(plain, ratio)
        tracker, _, seconds = tracked([(scan, Shown(range(count)))])
        views = tracker.keyframes
        size = sum(_bytes(view) for view in views) / len(views)
        rows.append(
            {"frames": count, "seconds": calibrated + seconds, "keyframes": len(views), "bytes_per_keyframe": size}
        )
    return {"cases": rows}


def _bytes(value: Any) -> int:
    """Bytes of the arrays that an object holds."""
    if isinstance(value, np.ndarray):
        return value.nbytes
    if isinstance(value, tuple | list):
        return sum(map(_bytes, value))
    return sum(map(_bytes, vars(value).values())) if hasattr(value, "__dict__") else 0


def _pieces(tracker: rgbd.RgbdTracker, trajectory: Trajectory) -> Figures:
    submaps = tracker.submaps()
    status, counts = np.unique(trajectory.status, return_counts=True)
    return {
        "with_pose": int(trajectory.has_pose.sum()),
        "status": dict(zip(status.tolist(), counts.tolist(), strict=True)),
        "submaps": [[int(s.frames[0]), int(s.frames[-1]), len(s.frames)] for s in submaps],
        "keyframes": sum(len(s.keyframes) for s in submaps),
        "closures": sum(len(s.closures) for s in submaps),
        "refused": int(sum((~s.held).sum() for s in submaps)),
    }


def tabulate_stress(rows: list[Figures]) -> list[str]:
    """A line for each altered sequence."""
    full = {row["capture"]: row["ate_rmse_m"] for row in rows if row.get("sequence") == "full" and "ate_rmse_m" in row}
    lines: list[tuple[str, ...]] = []
    for row in rows:
        if "error" in row:
            lines.append(
                (row["capture"], row.get("sequence", "–"), f"not available, {row['error']}", "–", "–", "–", "–")
            )
            continue
        ate, base = row.get("ate_rmse_m"), full.get(row["capture"])
        lost = row["status"].get("lost", 0)
        expected = f" ({row['expected_lost']} show nothing)" if row.get("expected_lost") else ""
        submaps = ", ".join(f"{first}–{last}" for first, last, _ in row["submaps"])
        gap = f"; back at its start {100 * row['gap_m']:.2f} cm off" if "gap_m" in row else ""
        lines.append(
            (
                row["capture"],
                row["sequence"] + gap,
                "–" if ate is None else f"{100 * ate:.2f}",
                "–" if ate is None or not base else f"{ate / base:.2f}",
                f"{row['with_pose']} of {row['frames']}",
                f"{lost}{expected}",
                f"{len(row['submaps'])}: {submaps}",
            )
        )
    return tabulate(("capture", "sequence", "ATE cm", "x full", "with a pose", "lost", "submaps"), lines)


def tabulate_lengths(rows: list[Figures]) -> list[str]:
    """A line for each length."""
    lines = [
        (row["capture"], f"not available, {row['error']}", "–", "–", "–", "–")
        if "error" in row
        else (
            row["capture"],
            str(row["frames"]),
            f"{row['seconds']:.1f}",
            f"{1e3 * row['seconds'] / row['frames']:.1f}",
            str(row["keyframes"]),
            f"{1e-3 * row['bytes_per_keyframe']:.0f}",
        )
        for row in rows
    ]
    return tabulate(("capture", "frames", "layer 1, s", "ms/frame", "keyframes", "kB a keyframe"), lines)


def warm_up(capture: str) -> Figures:
    """Compile all kernels, so that no measurement includes compilation."""
    plain = open_capture(Path(capture), Options())
    few = range(0, min(len(plain), 40), 8)
    tracked([(plain, Shown(few))])
    return {}
