"""A capture written in every format: how well it is tracked, and what opening and reading it cost.

The writers are those of the tests.
"""

from __future__ import annotations

import gc
import os
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

from freeocc3d.capture import open_capture, select_frames
from freeocc3d.capture.base import Capture
from freeocc3d.capture.focal_correction import Reregistered
from freeocc3d.core.errors import FreeOccError
from freeocc3d.core.types import Frame
from freeocc3d.evaluation.trajectory_errors import measure_trajectory_errors
from freeocc3d.tracking.rgbd import focal_calibration
from freeocc3d.tracking.rgbd.measured_pairs import measure_pairs
from freeocc3d.tracking.trajectory_alignment import Poses, align_trajectories

from .decoding import ExrImages, PackedImages, VideoImages, import_helper
from .figures import Figures, format_number, tabulate
from .tracking_stress import Shown, tracked

PIECE, READ, REPEATS = 120, 24, 4
"""Frames that are tracked; frames that are timed, and how often each."""

MANY, MANY_READ, WARM = 10_000, 2_000, 200
"""Frames of the capture that is opened, and how many are read, after some that are not counted."""

BASE = "ScanNet, exported"
"""The format that others are compared with."""

Scan = Any
Written = Any


def measure_formats(capture: str) -> Figures:
    """A row for each format, those of color alone without a trajectory."""
    written = import_helper("written_captures").WRITTEN
    scan, base = take_piece(capture), None
    cases = []
    for name in sorted(written, key=lambda name: name != BASE):
        facts = {"format": name, "reader": written[name].reader}
        try:
            with tempfile.TemporaryDirectory(prefix="freeocc3d-format-") as temporary:
                row, frames = measure_format(written[name], scan, Path(temporary), base)
        except FreeOccError as error:
            cases.append({**facts, "error": str(error)})
            continue
        ate = row.get("ate_rmse_m", float("nan"))
        base = base or (frames, ate)
        cases.append({**facts, **row, "over_base": ate / base[1]})
    return {"cases": cases}


def take_piece(capture: str) -> Scan:
    """The first frames of a capture with poses, in memory."""
    opened = open_capture(capture)
    frames = [opened[index] for index in range(min(PIECE, len(opened)))]
    return import_helper("scans").Scan(
        [frame.color for frame in frames],
        [frame.depth_m for frame in frames],
        [frame.intrinsics for frame in frames],
        [opened.pose(index) for index in range(len(frames))],
        [1_700_000_000.25 + round(index / 30, 3) for index in range(len(frames))],
    )


def measure_format(
    written: Written, scan: Scan, folder: Path, base: tuple[list[Frame], float] | None
) -> tuple[Figures, list[Frame]]:
    """The figures of a format, and its frames. base: the frames and the ATE of another format; frames that are equal
    to these are not tracked again."""
    capture = open_capture(_write(written, folder / "piece", scan), written.make_options())
    figures = {"frames": len(capture), **_time_reading(written, capture, scan, folder)}
    frames = [capture[index] for index in range(len(capture))]
    if written.unit_m is not None:
        if base is not None and _are_equal(frames, base[0]):
            figures |= {"ate_rmse_m": base[1], "with_pose": len(frames), "equal": True}
        else:
            figures |= _track(capture, scan)
    return {**figures, **_measure_many(written, folder / "many")}, frames


def tabulate_formats(rows: Sequence[Figures]) -> list[str]:
    """A line for each format."""
    header = (
        "capture", "format", "reader", "ATE mm", "over ScanNet's (asked 0.95 to 1.05)", "posed", "reading, ms",
        "decoding alone, ms", "over decoding (asked <= 1.2)", f"s to open {MANY:,} (asked <= 2)",
        f"MB more after {MANY_READ:,} reads (asked none)",
    )  # fmt: skip
    lines = [
        (row["capture"], row.get("format", "–"), f"not available, {row['error']}", *["–"] * (len(header) - 3))
        if "error" in row
        else (
            row["capture"],
            row["format"],
            row["reader"],
            format_number(row.get("ate_rmse_m"), 1e3, 2),
            "equal frames" if row.get("equal") else format_number(row.get("over_base"), 1, 3),
            f"{row['with_pose']} of {row['frames']}" if "with_pose" in row else "–",
            format_number(row["reading_s"], 1e3, 2),
            format_number(row["decoding_s"], 1e3, 2),
            format_number(row["reading_s"] / row["decoding_s"], 1, 2),
            format_number(row.get("opening_s"), 1, 2),
            format_number(row.get("growth_bytes"), 1e-6, 1),
        )
        for row in rows
    ]
    return tabulate(header, lines)


def _write(written: Written, folder: Path, scan: Scan) -> Path:
    folder.mkdir(parents=True)
    path: Path = written.write(folder, scan)
    return path


def _are_equal(frames: Sequence[Frame], others: Sequence[Frame]) -> bool:
    return len(frames) == len(others) and all(
        a.intrinsics == b.intrinsics and np.array_equal(a.color, b.color) and np.array_equal(a.depth_m, b.depth_m)
        for a, b in zip(frames, others, strict=True)
    )


def _track(capture: Capture, scan: Scan) -> Figures:
    """Layer 1 as the pipeline runs it, against the poses of the scan."""
    ratio = focal_calibration.estimate_color_focal(measure_pairs(capture, select_frames(capture)))
    shown: Capture = capture if ratio == 1 else Reregistered(capture, ratio)
    _, trajectory, _ = tracked([(shown, Shown(range(len(capture))))])
    rows = np.flatnonzero(trajectory.has_pose).tolist()
    estimated = Poses(trajectory.timestamps[rows], trajectory.T_world_cam[rows])
    true = Poses(trajectory.timestamps[rows], np.stack([scan.T_world_cam[row] for row in rows]))
    errors = measure_trajectory_errors(estimated, true, align_trajectories(estimated, true))
    return {"ate_rmse_m": errors.ate_rmse_m, "with_pose": len(rows)}


def _time_reading(written: Written, capture: Capture, scan: Scan, folder: Path) -> Figures:
    """Seconds per frame of the capture, and of decoding its images alone, by turns: the fastest of several runs.
    Processor time, which other work on the machine changes less; for videos, which other processes decode, all time."""
    clock = time.perf_counter if written.color == "video" else time.process_time
    with ExitStack() as stack:
        decode = _decoding(written, scan, folder, stack)
        fastest = np.full((2, READ), np.inf)
        for _ in range(REPEATS):
            for index in range(READ):
                for row, work in enumerate((capture.__getitem__, decode)):
                    mark = clock()
                    work(index)
                    fastest[row, index] = min(fastest[row, index], clock() - mark)
    reading_s, decoding_s = fastest.mean(axis=1).tolist()
    return {"reading_s": reading_s, "decoding_s": decoding_s}


def _decoding(written: Written, scan: Scan, folder: Path, stack: ExitStack) -> Callable[[int], object]:
    """Decodes the images of a frame, color to RGB and depth to meters."""

    def images(kind: str, stored: list[Any], name: str) -> Any:
        if kind == "video":
            found: Any = VideoImages(folder / f"{name}.mp4", stored)
        elif kind == "exr":
            found = ExrImages(folder / name, stored)
        else:
            found = PackedImages(folder / name, stored, kind)
        stack.callback(found.close)
        return found

    color = images(written.color, [scan.color[index] for index in range(READ)], "color")
    if written.unit_m is None:
        return color
    floats = not written.unit_m
    stored = [scan.depth_m[index] if floats else scan.stored(index) for index in range(READ)]
    depth = images(written.depth, stored, "depth")
    sure = None
    if written.confidence is not None:
        sure = images(written.confidence, [scan.sure((0, 1, 2))] * READ, "confidence")

    def decode(index: int) -> object:
        measured = depth(index).astype(np.float32) * np.float32(written.unit_m or 1)
        return color(index), measured, sure(index) if sure else None

    return decode


def _measure_many(written: Written, folder: Path) -> Figures:
    """Seconds to open many tiny frames, and how memory grows when they are read."""
    if not written.registered:  # it has frames of one size, which is not tiny
        return {}
    few = import_helper("scans").plane_scan(1)
    cameras, poses = list(few.cameras), list(few.T_world_cam)
    times = [1_700_000_000.25 + round(index / 30, 3) for index in range(MANY)]
    scan = type(few)(few.color * MANY, few.depth_m * MANY, cameras * MANY, poses * MANY, times)
    path = _write(written, folder, scan)
    mark = time.perf_counter()
    capture = open_capture(path, written.make_options())
    opening_s = time.perf_counter() - mark
    assert len(capture) == MANY
    before = 0
    for index in range(WARM + MANY_READ):
        if index == WARM:
            before = _resident()
        _ = capture[index]
    return {"opening_s": opening_s, "growth_bytes": _resident() - before}


def _resident() -> int:
    gc.collect()
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * os.sysconf("SC_PAGESIZE")
