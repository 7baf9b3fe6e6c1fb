"""What a capture is, and what a run would do with it: format, frames, cameras, depth, times, poses, and what to fix."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..capture import Capture, open_capture, select_frames
from ..capture.checks.depth_units import UNITS, DepthSample, sample_depth, settle_depth_unit
from ..capture.checks.file_heads import check_heads
from ..capture.rgbd_frames import RgbdFrames
from ..core.errors import CaptureError, FreeOccError
from ..core.sampling import spread_evenly
from ..core.types import Frame
from ..core.warnings import Notice
from ..settings import config
from ..settings.config import Settings
from ..tracking.rgbd.measured_pairs import measure_pairs
from .calibration import estimate_unknown_focal, register_color
from .checks import check_brightness, warn_of_camera
from .sensor_choice import choose_sensor
from .tracking_choice import choose_tracker

_SAMPLES = 9
_POSES_LOOKED_AT = 200


@dataclass(frozen=True)
class DepthFacts:
    """Depth of sampled frames. unit: units per meter.  median_m, far_m: below which half and 95 % of it lie, meters.
    coverage: share of the pixels with depth within ``capture.max_depth``.  sensor: whose noise it has."""

    unit: float
    median_m: float
    far_m: float
    coverage: float
    size: tuple[int, int]
    sensor: str


@dataclass(frozen=True)
class Inspection:
    """What is known of a capture. size: of its color images as stored.  frame_size: of what a run uses.  camera: where
    the focal length, in pixels of the stored color, comes from.  seconds: of the whole capture, None without times.
    poses: share of the frames that state one.  problems: sampled frames that cannot be used.  notices: what to fix."""

    path: Path
    format: str
    frames: int
    size: tuple[int, int]
    frame_size: tuple[int, int]
    camera: str
    depth: DepthFacts | None
    seconds: float | None
    poses: float
    tracking: str
    problems: tuple[str, ...]
    notices: tuple[Notice, ...]

    @property
    def rate(self) -> float | None:
        """Frames a second; None without times."""
        return None if not self.seconds else (self.frames - 1) / self.seconds

    def to_dict(self) -> dict[str, Any]:
        """Plain values."""
        depth = None
        if self.depth is not None:
            found = self.depth
            depth = {
                "units_per_meter": found.unit, "median_m": round(found.median_m, 3), "p95_m": round(found.far_m, 3),
                "coverage": round(found.coverage, 3), "size": list(found.size), "sensor": found.sensor,
            }  # fmt: skip
        return {
            "path": str(self.path), "format": self.format, "frames": self.frames, "color_size": list(self.size),
            "frame_size": list(self.frame_size), "camera": self.camera, "depth": depth, "seconds": self.seconds,
            "frames_per_second": None if self.rate is None else round(self.rate, 2), "poses": round(self.poses, 3),
            "tracking": self.tracking, "problems": list(self.problems),
            "warnings": [notice.to_dict() for notice in self.notices],
        }  # fmt: skip


def inspect(path: str | Path, settings: Settings | None = None) -> Inspection:
    """Open a capture, look at some of its frames, and say what a run would do. Raises CaptureError with what lies there
    if it is no capture."""
    settings = settings or config.resolve({})
    capture = open_capture(path, settings.capture, settings.backends.get("capture"))
    used, notices = select_frames(capture), list(capture.warnings)
    try:
        notices += [broken] if (broken := check_heads(capture, used)) else []
    except CaptureError as error:
        notices.append(Notice("images-unreadable", str(error)))
    if unit := settle_depth_unit(capture):
        notices.append(unit)
    _, tracking = choose_tracker(settings, capture)
    frames, problems = _look(capture)
    camera, more = _describe_camera(capture, frames)
    notices += more
    if capture.has_depth and settings.capture.color_focal is None:
        notices += register_color(capture, used, measure_pairs(capture, used))[1]
    if dark := check_brightness(frames, capture.path):
        notices.append(dark)
    first = frames[0] if frames else None
    frame_size = first.color.shape[1::-1] if first is not None else (0, 0)
    return Inspection(
        path=capture.path,
        format=capture.format,
        frames=len(capture),
        size=_stored_size(capture, frame_size),
        frame_size=frame_size,
        camera=camera,
        depth=_describe_depth(capture, frames, settings) if capture.has_depth else None,
        seconds=_duration(capture),
        poses=_share_of_poses(capture),
        tracking=tracking or f"Tracking with {settings.tracking.backend}, as the options say.",
        problems=tuple(problems),
        notices=tuple(notices),
    )


def _look(capture: Capture) -> tuple[list[Frame], list[str]]:
    """Frames across the capture, and what keeps others from being used."""
    used = select_frames(capture)
    frames, problems = [], []
    for row in spread_evenly(len(used), _SAMPLES):
        try:
            frames.append(capture[used[row]])
        except FreeOccError as error:
            problems.append(str(error))
    return frames, problems


def _stored_size(capture: Capture, frame_size: tuple[int, int]) -> tuple[int, int]:
    if not isinstance(capture, RgbdFrames):
        return frame_size
    camera = capture.rig(0).color.camera
    return camera.width, camera.height


def _describe_camera(capture: Capture, frames: list[Frame]) -> tuple[str, list[Notice]]:
    """Where the focal length comes from, and what to fix about it."""
    if not frames:
        return "unknown", []
    if not isinstance(capture, RgbdFrames) or not capture.has_depth:
        focal = frames[0].intrinsics.fx
        if capture.intrinsics_known:
            return f"stated, focal length {focal:.0f} px", []
        how = "roughly stated" if capture.focal_stated else "not stated; a run estimates it"
        return f"{how}, start {focal:.0f} px", [] if capture.focal_stated else [warn_of_camera(capture)]
    if capture.intrinsics_known:
        return f"stated, focal length {capture.rig(0).color.camera.fx:.0f} px", []
    found = estimate_unknown_focal(capture, select_frames(capture))
    if found.focal_px is None:
        return "not stated", [found.notice]
    if found.notice.code == "intrinsics-unknown":
        return f"roughly stated, focal length {found.focal_px:.0f} px", [found.notice]
    return f"not stated; the scan shows a focal length of {found.focal_px:.0f} px", [found.notice]


def _describe_depth(capture: Capture, frames: list[Frame], settings: Settings) -> DepthFacts | None:
    sample = sample_depth(capture)
    if sample is None:  # not stored, but made
        measured = np.sort(
            np.concatenate([frame.depth_m[frame.depth_m > 0] for frame in frames] or [np.zeros(0, np.float32)])
        )
        sample = DepthSample(measured, 1.0)
    if not len(sample.values) or not frames:
        return None
    unit = sample.units_per_meter
    if isinstance(capture, RgbdFrames):
        unit = capture.units_per_meter or unit
        camera = capture.rig(0).depth.camera
        size = camera.width, camera.height
    else:
        size = frames[0].depth_m.shape[1::-1]
    coverage = float(np.mean([(frame.depth_m > 0).mean() for frame in frames]))
    sensor = choose_sensor(settings, capture)[0].capture.sensor
    return DepthFacts(unit, sample.quantile_m(0.5, unit), sample.quantile_m(0.95, unit), coverage, size, sensor)


def _duration(capture: Capture) -> float | None:
    """Seconds of the capture; None if its times only count frames."""
    times = capture.timestamps
    counts = len(times) < 2 or np.array_equal(times - times[0], np.arange(len(times)))
    return None if counts else float(times[-1] - times[0])


def _share_of_poses(capture: Capture) -> float:
    """Share of the frames that state a pose, of some that are looked at."""
    rows = spread_evenly(len(capture), _POSES_LOOKED_AT)
    try:
        return float(np.mean([capture.pose(row) is not None for row in rows]))
    except FreeOccError:
        return 0.0


def unit_name(units_per_meter: float) -> str:
    """Units per meter in words."""
    name = UNITS.get(units_per_meter)
    return f"{units_per_meter:g} units per meter" + (f" ({name})" if name else "")
