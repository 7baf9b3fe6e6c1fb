"""Multi-view stereo on a capture's color at its true poses, compared with its depth."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from freeocc3d.capture import open_capture, select_frames
from freeocc3d.capture.base import Capture, Options
from freeocc3d.capture.cameras.depth_registration import PixelGrid
from freeocc3d.core.progress import Progress
from freeocc3d.core.types import Frame
from freeocc3d.depth import multi_view_stereo
from freeocc3d.depth.sparse_points import triangulate
from freeocc3d.tracking.rgbd import focal_calibration
from freeocc3d.tracking.rgbd.measured_pairs import measure_pairs
from freeocc3d.tracking.trackers import known

from .figures import Figures

ASKED = "<= 1.5 % (rendered), <= 3 % (kitchen), >= 40 % kept"
_CLOSE = 0.01  # meters from frame to frame: every fifth frame is used below it, every third above it
_AROUND = 10  # frames on either side that stereo also uses


def measure_stereo(capture: str, frames: int | None = None) -> Figures:
    """Median relative error, share of the pixels with a true depth that are kept, and seconds a frame.

    frames: number of compared frames, spread over the scan; None = all.
    """
    opened = open_capture(capture)
    stride = 5 if _spacing(opened) < _CLOSE else 3
    opened = open_capture(capture, Options(stride=stride))
    used = list(select_frames(opened))
    ratio = focal_calibration.estimate_color_focal(measure_pairs(opened, select_frames(opened)))

    def color(frame: Frame) -> Frame:
        camera = frame.intrinsics
        return replace(frame, intrinsics=replace(camera, fx=camera.fx * ratio, fy=camera.fy * ratio))

    compared = used if frames is None else used[:: max(1, len(used) // frames)][:frames]
    T_world_cam = known.load(known.Options(), opened).T_world_cam
    with tempfile.TemporaryDirectory() as folder:
        depth = multi_view_stereo.StereoDepth(Path(folder), multi_view_stereo.Options())
        started, cpu = time.perf_counter(), time.process_time()
        scan = triangulate(opened, T_world_cam, used, Progress(), color)
        depth.compute(opened, scan, _with_others(compared, used), Progress(), color)
        done = len(_with_others(compared, used))
        seconds, cpu = (time.perf_counter() - started) / done, (time.process_time() - cpu) / done
        errors, in_sigmas, true = [], [], 0
        for index in compared:
            frame = opened[index]
            truth = (
                PixelGrid(frame.intrinsics, color(frame).intrinsics).depth(frame.depth_m)
                if ratio != 1
                else frame.depth_m
            )
            true += int(np.count_nonzero(truth))
            found = depth.depth(index)
            if found is not None:
                both = (truth > 0) & (found[0] > 0)
                off = np.abs(found[0] - truth)[both]
                errors.append(off / truth[both])
                in_sigmas.append(off / found[1][both])
    return {**_figures(errors, in_sigmas, true), "frames": done, "compared": len(compared),
            "seconds_per_frame": seconds, "processor_seconds_per_frame": cpu}  # fmt: skip


def _figures(errors: list[NDArray[Any]], in_sigmas: list[NDArray[Any]], true: int) -> Figures:
    relative, sigmas = np.concatenate([np.zeros(0), *errors]), np.concatenate([np.zeros(0), *in_sigmas])
    return {
        "median_relative_error": float(np.median(relative)) if len(relative) else None,
        "kept": len(relative) / max(true, 1),
        "within_5_percent": float((relative < 0.05).mean()) if len(relative) else None,
        "errors_within_a_sigma": float((sigmas < 1.0).mean()) if len(sigmas) else None,
    }


def _with_others(compared: Sequence[int], used: Sequence[int]) -> list[int]:
    """The compared frames and those around them, which have to confirm their depth."""
    rows = {row for index in compared for row in range(used.index(index) - _AROUND, used.index(index) + _AROUND + 1)}
    return [used[row] for row in sorted(rows) if 0 <= row < len(used)]


def _spacing(capture: Capture) -> float:
    """Median distance from one frame to the next, meters."""
    poses = [capture.pose(index) for index in range(min(len(capture), 200))]
    places = np.array([pose[:3, 3] for pose in poses if pose is not None])
    return float(np.median(np.linalg.norm(np.diff(places, axis=0), axis=1)))


def tabulate_stereo(rows: list[Figures]) -> list[str]:
    """Table of ``measure_stereo`` of several captures, each with its name as "capture"."""
    if not rows:
        return []
    lines = [
        f"\nDepth from color alone at true poses (asked: {ASKED})\n",
        "| capture | median relative error % | kept % | within 5 % | errors within a sigma % | s/frame | CPU s/frame |",
        "|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        if "error" in row:
            lines.append(f"| {row['capture']} | not available: {row['error']} | | | | | |")
            continue
        shares = ("median_relative_error", "kept", "within_5_percent", "errors_within_a_sigma")
        cells = ["-" if row[name] is None else f"{100 * row[name]:.1f}" for name in shares]
        cells += [f"{row[name]:.2f}" for name in ("seconds_per_frame", "processor_seconds_per_frame")]
        lines.append(f"| {' | '.join((row['capture'], *cells))} |")
    return lines
