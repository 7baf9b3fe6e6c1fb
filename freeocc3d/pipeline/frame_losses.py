"""Why frames were lost: what was measured in them, compared with the frames that were tracked."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ..capture import Capture
from ..core.errors import FrameError
from ..core.sampling import spread_evenly
from ..core.types import Frame, Trajectory
from ..tracking.rgbd import orb_features

_SAMPLES = 8
_SHALLOW = (
    "have depth in {:.0%} of their pixels: stay within the sensor's range and capture.max_depth, check "
    "capture.depth_scale, and look at more than glass and mirrors"
)
_SHALLOW_STEREO = (
    "got depth from stereo in {:.0%} of their pixels: use more images, move the camera sideways, do not only turn it, "
    "and look at more than bare surfaces"
)

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


def explain_losses(
    capture: Capture,
    trajectory: Trajectory,
    poses: NDArray[np.float64] | None = None,
    given: bool = False,
    complete: Callable[[Frame], Frame] = lambda frame: frame,
) -> str:
    """A sentence about the causes that show in a sample of the lost frames; an empty text if none are lost.

    poses: (N, 4, 4) T_world_cam of all frames that are known before tracking, NaN without; None if there are none.
    given: whether these come from files.  complete: gives a frame the depth with which it was tracked.
    """
    used = np.flatnonzero(trajectory.status != "unused")
    lost = np.flatnonzero(trajectory.status == "lost")
    if not len(lost):
        return ""
    said = ""
    if poses is not None and given:
        unposed = ~np.isfinite(poses[lost]).all(axis=(1, 2))
        lost = lost[~unposed]
        if not len(lost):
            return "They have no pose."
        said = f"Without a pose: {np.count_nonzero(unposed)}. " if unposed.any() else ""
    sample = _Sample(capture, used, complete)
    found = sample.measure(lost)
    if not found:
        return f"{said}None of them can be read any more."
    tracked = np.setdiff1d(used[np.isin(trajectory.status[used], ("keyframe", "tracked", "relocalised"))], lost)
    posed = poses is None or bool(np.isfinite(poses[lost]).all())  # then depth was looked for
    causes = _causes(found, sample.measure(tracked), capture.has_depth, capture.has_depth or posed)
    if causes:
        return f"{said}Of {len(found)} of them that were looked at, {'; '.join(causes)}."
    likely = (
        "the camera's calibration or the registration of depth to color is the likely cause"
        if capture.has_depth
        else "a camera that only turns, or surfaces without detail, are the likely cause: move it sideways"
    )
    return (
        f"{said}The {len(found)} of them that were looked at are bright and sharp, and share their view with the frame "
        f"before, so that {likely}."
    )


def _causes(
    found: Sequence[FrameQuality], others: Sequence[FrameQuality], has_depth: bool, needs_depth: bool
) -> list[str]:
    """What is measured, with what to do, the most frequent cause first. has_depth: whether depth is the sensor's.
    needs_depth: whether the frames are lost if they have none."""
    sharp = float(np.median([other.sharpness for other in others])) if others else 0.0
    dark = [one for one in found if one.brightness < DARK]
    blurred = [one for one in found if one.brightness >= DARK and one.sharpness < BLURRED * sharp]
    shallow = [one for one in found if needs_depth and one.depth < FEW_DEPTH]
    apart = [
        one
        for one in found
        if one.matches is not None and one.matches < FEW_MATCHES and one not in (*dark, *blurred, *shallow)
    ]
    said = [
        (dark, "are nearly black (95 % of their pixels below {:.0f} of 255): more light, or a longer exposure",
         lambda one: one.brightness),
        (blurred, "are blurred (sharpness {:.2f} of that of tracked frames): move slower, or use more light",
         lambda one: one.sharpness / max(sharp, 1e-9)),
        (shallow, _SHALLOW if has_depth else _SHALLOW_STEREO, lambda one: one.depth),
        (apart, "share little with the frame before ({:.0f} matched features): film slower, at a higher rate, or use "
         "more frames (capture.stride)", lambda one: one.matches),
    ]  # fmt: skip
    frequent = sorted(((group, text, value) for group, text, value in said if group), key=lambda one: -len(one[0]))
    return [f"{len(group)} {text.format(np.median([value(one) for one in group]))}" for group, text, value in frequent]


@dataclass(frozen=True)
class _Sample:
    """Measures some frames of a capture. used: the frames that were to be tracked."""

    capture: Capture
    used: NDArray[np.int64]
    complete: Callable[[Frame], Frame]

    def measure(self, rows: NDArray[np.int64]) -> list[FrameQuality]:
        """The quality of some of the frames, evenly chosen, that can be read."""
        chosen = rows[spread_evenly(len(rows), _SAMPLES)]
        return [quality for row in chosen.tolist() if (quality := self._measure(row)) is not None]

    def _measure(self, index: int) -> FrameQuality | None:
        """The quality of a frame; None if it cannot be read."""
        frame = self._read(index)
        if frame is None:
            return None
        gray = cv2.cvtColor(frame.color, cv2.COLOR_RGB2GRAY)
        row = int(np.searchsorted(self.used, index))
        other = self._read(int(self.used[row - 1 if row else min(1, len(self.used) - 1)]))
        matches = None if other is None else _count_matches(frame, other)
        spread = max(float(gray.var()), 1.0)
        sharpness = float(cv2.Laplacian(gray, cv2.CV_32F).var()) / spread
        depth = float((self.complete(frame).depth_m > 0).mean())
        return FrameQuality(float(np.percentile(gray, 95)), sharpness, depth, matches)

    def _read(self, index: int) -> Frame | None:
        try:
            return self.capture[index]
        except FrameError:
            return None


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
