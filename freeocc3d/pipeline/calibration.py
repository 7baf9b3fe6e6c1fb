"""What a scan itself shows of its cameras before it is tracked, for a run and for ``inspect``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from ..capture import Capture
from ..capture.checks.registration_check import check_registration
from ..capture.focal_correction import Reregistered
from ..capture.rgbd_frames import RgbdFrames
from ..core.warnings import Notice
from ..tracking.rgbd import focal_calibration, self_calibration
from ..tracking.rgbd.measured_pairs import MeasuredPair
from .checks import (
    explain_unknown_camera,
    warn_of_camera,
    warn_of_color_focal,
    warn_of_estimated_focal,
    warn_of_registration,
)


@dataclass(frozen=True)
class FocalLength:
    """A focal length in pixels of the stored color images; None = nothing tells it. notice: what the user should know
    about it."""

    focal_px: float | None
    notice: Notice


def estimate_unknown_focal(capture: RgbdFrames, frames: range) -> FocalLength:
    """The focal length of a capture with depth that states none: from the scan if it shows it well, else roughly from
    the files, else none."""
    stored, guess = capture.rig(frames[0]).color.camera, capture.registration(frames[0]).intrinsics
    found = self_calibration.estimate_focal(capture, frames)
    factor = stored.fx / guess.fx
    if found is not None and found.sure:
        focal_px = round(found.focal_px * factor, 1)
        return FocalLength(focal_px, warn_of_estimated_focal(capture, focal_px, found.uncertainty))
    if capture.focal_stated:
        return FocalLength(stored.fx, warn_of_camera(capture))
    roughly = "" if found is None else found.describe(factor)
    text = explain_unknown_camera(capture, (stored.width, stored.height), roughly)
    return FocalLength(None, Notice("intrinsics-unknown", text))


def register_color(capture: Capture, frames: range, pairs: Sequence[MeasuredPair]) -> tuple[Capture, list[Notice]]:
    """The capture with color registered to the depth images, if pairs of frames show that the focal lengths of its
    cameras differ, and what the user should know about color and depth."""
    fit = focal_calibration.fit_color_focal(pairs)
    registered = capture if fit.ratio == 1 else Reregistered(capture, fit.ratio)
    notices = [] if fit.ratio == 1 else [warn_of_color_focal(capture, fit.ratio)]
    if doubt := check_registration(registered, frames):
        notices.append(doubt)
    elif fit.out_of_range:
        notices.append(warn_of_registration(capture))
    return registered, notices
