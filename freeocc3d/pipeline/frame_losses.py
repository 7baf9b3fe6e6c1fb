"""Why frames were lost: what was measured in them, compared with the frames that were tracked."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ..capture import Capture
from ..core.errors import FrameError
from ..core.types import Frame, Trajectory
from ..tracking.rgbd import orb_features

_SAMPLES = 8

DARK = 40.0
"""A frame is dark if 95 % of its pixels are below this brightness, 0…255."""

BLURRED = 0.3
"""A frame is blurred if its sharpness is below this share of that of tracked frames."""

FEW_DEPTH = 0.15
"""A frame has little depth if fewer of its pixels have any."""

FEW_MATCHES = 40
"""Frames with fewer matched features that agree on one motion share little of their view."""

_LEAST_FOR_MOTION, _MOTION_PX = 12, 1.5


@dataclass(frozen=True)
class FrameQuality:
    """What a frame is worth for tracking. brightness: 95th percentile, 0…255.  sharpness: variance of the Laplacian
    over that of the brightness.  depth: share of the pixels with depth.  matches: with the used frame before (after the
    first); None if that is unreadable."""

    brightness: float
    sharpness: float
    depth: float
    matches: int | None


def explain_losses(capture: Capture, trajectory: Trajectory) -> str:
    """A sentence about the causes that show in a sample of the lost frames; an empty text if none are lost."""
    used = np.flatnonzero(trajectory.status != "unused")
    lost = np.flatnonzero(trajectory.status == "lost")
    if not len(lost):
        return ""
    found = [quality for row in _spread(lost) if (quality := _measure(capture, used, row)) is not None]
    tracked = np.setdiff1d(used[np.isin(trajectory.status[used], ("keyframe", "tracked", "relocalised"))], lost)
    others = [quality for row in _spread(tracked) if (quality := _measure(capture, used, row)) is not None]
    causes = _causes(found, others, capture.has_depth)
    if not found:
        return "None of them can be read any more."
    if not causes:
        return (
            f"The {len(found)} of them that were looked at are bright and sharp, and share their view with the frame "
            "before, so that the camera's calibration or the registration of depth to color is the likely cause."
        )
    return f"Of {len(found)} of them that were looked at, {'; '.join(causes)}."


def _causes(found: Sequence[FrameQuality], others: Sequence[FrameQuality], has_depth: bool) -> list[str]:
    """What is measured, with what to do, the most frequent cause first."""
    sharp = float(np.median([other.sharpness for other in others])) if others else 0.0
    dark = [one for one in found if one.brightness < DARK]
    blurred = [one for one in found if one.brightness >= DARK and one.sharpness < BLURRED * sharp]
    shallow = [one for one in found if has_depth and one.depth < FEW_DEPTH]
    apart = [one for one in found if one.matches is not None and one.matches < FEW_MATCHES and one not in dark]
    said = [
        (dark, "are nearly black (95 % of their pixels below {:.0f} of 255): more light, or a longer exposure",
         lambda one: one.brightness),
        (blurred, "are blurred (sharpness {:.2f} of that of tracked frames): move slower, or use more light",
         lambda one: one.sharpness / max(sharp, 1e-9)),
        (shallow, "have depth in {:.0%} of their pixels: stay within the sensor's range and capture.max_depth, check "
         "capture.depth_scale, and look at more than glass and mirrors", lambda one: one.depth),
        (apart, "share little with the frame before ({:.0f} matched features): film slower, at a higher rate, or use "
         "more frames (capture.stride)", lambda one: one.matches),
    ]  # fmt: skip
    frequent = sorted(((group, text, value) for group, text, value in said if group), key=lambda one: -len(one[0]))
    return [f"{len(group)} {text.format(np.median([value(one) for one in group]))}" for group, text, value in frequent]


def _measure(capture: Capture, used: NDArray[np.int64], index: int) -> FrameQuality | None:
    """The quality of a frame; None if it cannot be read."""
    frame = _read(capture, index)
    if frame is None:
        return None
    gray = cv2.cvtColor(frame.color, cv2.COLOR_RGB2GRAY)
    row = int(np.searchsorted(used, index))
    other = _read(capture, int(used[row - 1 if row else min(1, len(used) - 1)]))
    matches = None if other is None else _count_matches(frame, other)
    spread = max(float(gray.var()), 1.0)
    sharpness = float(cv2.Laplacian(gray, cv2.CV_32F).var()) / spread
    return FrameQuality(float(np.percentile(gray, 95)), sharpness, float((frame.depth_m > 0).mean()), matches)


def _count_matches(a: Frame, b: Frame) -> int:
    """How many features of two frames match and agree on one motion of the camera."""
    seen = [orb_features.detect_features(one) for one in (a, b)]
    rows = orb_features.match_binary(*seen)
    if len(rows) < _LEAST_FOR_MOTION:
        return len(rows)
    cv2.setRNGSeed(1)
    points = [one.pixels[rows[:, side]] for side, one in enumerate(seen)]
    _, agreeing = cv2.findFundamentalMat(*points, cv2.USAC_MAGSAC, _MOTION_PX, 0.999, 1000)
    return 0 if agreeing is None else int(np.count_nonzero(agreeing))


def _read(capture: Capture, index: int) -> Frame | None:
    try:
        return capture[index]
    except FrameError:
        return None


def _spread(rows: NDArray[np.int64]) -> list[int]:
    """Some of the rows, evenly chosen."""
    chosen = np.unique(np.linspace(0, len(rows) - 1, _SAMPLES).astype(int)) if len(rows) else np.zeros(0, int)
    return [int(row) for row in rows[chosen]]
