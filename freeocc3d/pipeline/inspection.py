"""What a capture is, and what a run would do with it: format, frames, cameras, depth, times, poses, and what to fix."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..capture import Capture, open_capture
from ..capture.checks.depth_units import UNITS, DepthSample, sample_depth, settle_depth_unit
from ..capture.checks.file_heads import check_heads
from ..capture.checks.registration_check import check_registration
from ..capture.focal_correction import Reregistered
from ..capture.rgbd_frames import RgbdFrames
from ..core.errors import CaptureError, FreeOccError
from ..core.types import Frame
from ..core.warnings import Notice
from ..settings import config
from ..settings.config import Settings
from ..tracking.rgbd import focal_calibration, self_calibration
from ..tracking.rgbd.measured_pairs import measure_pairs
from .checks import (
    check_brightness,
    explain_unknown_camera,
    warn_of_camera,
    warn_of_color_focal,
    warn_of_estimated_focal,
)
from .tracking_choice import choose_tracker

_SAMPLES = 9
_POSES_LOOKED_AT = 200


@dataclass(frozen=True)
class DepthFacts:
    """Depth of sampled frames. unit: units per meter.  median_m, far_m: below which half and 95 % of it lie, meters.
    coverage: share of the pixels with depth within ``capture.max_depth``."""

    unit: float
    median_m: float
    far_m: float
    coverage: float
    size: tuple[int, int]


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
                "coverage": round(found.coverage, 3), "size": list(found.size),
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
    notices = list(capture.warnings)
    try:
        notices += [broken] if (broken := check_heads(capture, range(len(capture)))) else []
    except CaptureError as error:
        notices.append(Notice("images-unreadable", str(error)))
    if unit := settle_depth_unit(capture):
        notices.append(unit)
    _, tracking = choose_tracker(settings, capture)
    frames, problems = _look(capture)
    camera, more = _describe_camera(capture, frames)
    notices += more
    if capture.has_depth:
        notices += _check_color(capture)
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
        depth=_describe_depth(capture, frames) if capture.has_depth else None,
        seconds=_duration(capture),
        poses=_share_of_poses(capture),
        tracking=tracking or f"Tracking with {settings.tracking.backend}, as the options say.",
        problems=tuple(problems),
        notices=tuple(notices),
    )


def _look(capture: Capture) -> tuple[list[Frame], list[str]]:
    """Frames across the capture, and what keeps others from being used."""
    frames, problems = [], []
    for index in np.unique(np.linspace(0, len(capture) - 1, _SAMPLES).astype(int)).tolist():
        try:
            frames.append(capture[index])
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
    focal = frames[0].intrinsics.fx * _stored_size(capture, (1, 1))[0] / max(frames[0].color.shape[1], 1)
    if not isinstance(capture, RgbdFrames):
        focal = frames[0].intrinsics.fx
    if capture.intrinsics_known:
        return f"stated, focal length {focal:.0f} px", []
    if not capture.has_depth:
        how = "roughly stated" if capture.focal_stated else "not stated; a run estimates it"
        return f"{how}, start {focal:.0f} px", [] if capture.focal_stated else [warn_of_camera(capture)]
    found = self_calibration.estimate_focal(capture, range(len(capture)))
    size = _stored_size(capture, (1, 1))
    if (found is None or not found.sure) and capture.focal_stated:
        return f"roughly stated, focal length {focal:.0f} px", [warn_of_camera(capture)]
    if found is None or not found.sure:
        roughly = "" if found is None else found.describe(focal / frames[0].intrinsics.fx)
        return "not stated", [Notice("intrinsics-unknown", explain_unknown_camera(capture, size, roughly))]
    focal_px = focal * found.focal_px / frames[0].intrinsics.fx
    notice = warn_of_estimated_focal(capture, focal_px, found.uncertainty)
    return f"not stated; the scan shows a focal length of {focal_px:.0f} px", [notice]


def _check_color(capture: Capture) -> list[Notice]:
    """What is wrong between color and depth: another focal length, which a run corrects, or what it cannot."""
    frames = range(len(capture))
    ratio = capture.options.color_focal or focal_calibration.estimate_color_focal(measure_pairs(capture, frames))
    found = [] if ratio == 1 else [warn_of_color_focal(capture, ratio)]
    registered = capture if ratio == 1 else Reregistered(capture, ratio)
    notice = check_registration(registered, frames)
    return [*found, notice] if notice else found


def _describe_depth(capture: Capture, frames: list[Frame]) -> DepthFacts | None:
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
    return DepthFacts(unit, sample.quantile_m(0.5, unit), sample.quantile_m(0.95, unit), coverage, size)


def _duration(capture: Capture) -> float | None:
    """Seconds of the capture; None if its times only count frames."""
    times = capture.timestamps
    counts = len(times) < 2 or np.array_equal(times - times[0], np.arange(len(times)))
    return None if counts else float(times[-1] - times[0])


def _share_of_poses(capture: Capture) -> float:
    """Share of the frames that state a pose, of some that are looked at."""
    rows = np.unique(np.linspace(0, len(capture) - 1, _POSES_LOOKED_AT).astype(int)).tolist()
    try:
        return float(np.mean([capture.pose(row) is not None for row in rows]))
    except FreeOccError:
        return 0.0


def unit_name(units_per_meter: float) -> str:
    """Units per meter in words."""
    name = UNITS.get(units_per_meter)
    return f"{units_per_meter:g} units per meter" + (f" ({name})" if name else "")
