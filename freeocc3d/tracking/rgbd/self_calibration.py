"""Estimates the focal length of a scan with depth whose camera nobody knows.

Depth gives every feature its distance, and the focal length gives it its place across the image. A rigid motion between
two frames brings the features of one onto those of the other only if both are right: a turn moves what lies beside the
axis nearer or farther, by an amount that depends on the focal length. Of many focal lengths, the one with the least
error over all pairs is taken, if the pairs agree on it.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ...capture.base import Capture
from ...core.errors import FrameError
from ...core.sampling import spread_evenly
from ...core.types import Frame
from . import orb_features
from .orb_features import OrbFeatures

_FOCALS = np.exp(np.linspace(np.log(0.45), np.log(1.8), 57))
"""Focal lengths to try, over the longer side of the image: views of 96 to 31 degrees, in steps of 2.5 %."""

_PAIRS, _GAPS = 36, (24, 12, 6, 3, 1)
_LEAST_PAIRS, _LEAST_MATCHES = 4, 40
_FAR_PX, _FAR = 3.0, 0.02
"""Scales of the saturating error of a match: pixels across the image, and a share of the depth along it."""

_NEAREST_M = 0.05

_STEPS = 8  # of reweighted least squares
_SURE, _VAGUE = 0.03, 0.12
"""Largest relative standard errors, over the pairs, of a focal length that is taken, and of one that is told."""


@dataclass(frozen=True)
class FocalEstimate:
    """A focal length in pixels of the frames, and its relative standard error."""

    focal_px: float
    uncertainty: float

    def describe(self, factor: float) -> str:
        """The focal length times a factor and its error, such as "121 ± 6 %"; empty if it says next to nothing."""
        return f"{self.focal_px * factor:.0f} ± {self.uncertainty:.0%}" if self.uncertainty < _VAGUE else ""

    @property
    def sure(self) -> bool:
        """Whether the scan tells the focal length well enough to use it."""
        return self.uncertainty <= _SURE


@dataclass(frozen=True)
class _Matches:
    """M matched features of two frames: (M, 2) pixels from the image center, and (M,) depths, meters, in both.
    longer: side of the images, pixels."""

    a: NDArray[np.float64]
    b: NDArray[np.float64]
    depth_a: NDArray[np.float64]
    depth_b: NDArray[np.float64]
    longer: int = 0


def estimate_focal(capture: Capture, frames: range) -> FocalEstimate | None:
    """The focal length that the selected frames of a capture with depth show; None with too little to compare. Color
    and depth must be registered, with square pixels and the principal point in the middle."""
    pairs = _matched_pairs(capture, frames)
    if len(pairs) < _LEAST_PAIRS:
        return None
    longer = pairs[0].longer
    errors = np.array([[_error(pair, ratio * longer) for ratio in _FOCALS] for pair in pairs])
    best = _minimum(errors.mean(axis=0))
    if best is None:
        return None
    # Bootstrap over pairs: how much the minimum moves if other pairs had been seen.
    rng = np.random.default_rng(0)
    draws = [_minimum(errors[rng.integers(0, len(errors), len(errors))].mean(axis=0)) for _ in range(50)]
    logs = np.log([draw if draw is not None else _FOCALS[0] for draw in draws])
    return FocalEstimate(best * longer, float(logs.std()))


def _minimum(errors: NDArray[np.float64]) -> float | None:
    """The ratio of the least error, between the ones tried; None at the ends of what is tried."""
    row = int(np.argmin(errors))
    if row in (0, len(errors) - 1):
        return None
    a, b, _ = np.polyfit(np.log(_FOCALS[row - 1 : row + 2]), errors[row - 1 : row + 2], 2)
    return float(np.exp(-b / (2 * a)))


def _matched_pairs(capture: Capture, frames: range) -> list[_Matches]:
    """Pairs of frames, spread over the scan, as far apart as enough features can be matched."""
    found = []
    for start in spread_evenly(len(frames) - 1, _PAIRS):
        target = _seen(capture, frames[start])
        for gap in _GAPS:
            if target is None or start + gap >= len(frames):
                continue
            source = _seen(capture, frames[start + gap])
            matches = None if source is None else _match(source, target)
            if matches is not None:
                found.append(matches)
                break
    return found


def _seen(capture: Capture, index: int) -> tuple[Frame, OrbFeatures] | None:
    try:
        frame = capture[index]
    except FrameError:
        return None
    return frame, orb_features.detect_features(frame)


def _match(source: tuple[Frame, OrbFeatures], target: tuple[Frame, OrbFeatures]) -> _Matches | None:
    """Matches with depth in both frames that agree on one epipolar geometry; None if they are too few."""
    rows = orb_features.match_binary(source[1], target[1])
    if len(rows) < _LEAST_MATCHES:
        return None
    a, b = source[1].pixels[rows[:, 0]], target[1].pixels[rows[:, 1]]
    cv2.setRNGSeed(1)
    _, agreeing = cv2.findFundamentalMat(a, b, cv2.USAC_MAGSAC, 1.5, 0.999, 2000)
    if agreeing is None:
        return None
    depth_a, depth_b = _look_up(source[0], a), _look_up(target[0], b)
    kept = (agreeing[:, 0] > 0) & (depth_a > 0) & (depth_b > 0)
    if kept.sum() < _LEAST_MATCHES:
        return None
    height, width = source[0].color.shape[:2]
    center = np.array(((width - 1) / 2, (height - 1) / 2))
    return _Matches(a[kept] - center, b[kept] - center, depth_a[kept], depth_b[kept], max(width, height))


def _look_up(frame: Frame, pixels: NDArray[np.float32]) -> NDArray[np.float64]:
    """(M,) depth at pixels, meters; 0 where a neighbor is missing or far off, as at edges."""
    u, v = np.rint(pixels).astype(int).T
    height, width = frame.depth_m.shape
    u, v = np.clip(u, 1, width - 2), np.clip(v, 1, height - 2)
    around = np.stack([frame.depth_m[v + dv, u + du] for dv in (-1, 0, 1) for du in (-1, 0, 1)])
    near, far = around.min(axis=0), around.max(axis=0)
    return np.where((near > 0) & (far < 1.05 * near), np.median(around, axis=0), 0.0).astype(np.float64)


def _error(pair: _Matches, focal: float) -> float:
    """Mean saturating error, 0…1, of the best rigid motion between the matches, for a focal length in pixels."""
    p = np.column_stack((pair.a / focal, np.ones(len(pair.a)))) * pair.depth_a[:, None]
    q = np.column_stack((pair.b / focal, np.ones(len(pair.b)))) * pair.depth_b[:, None]
    weight = np.ones(len(p))
    for _ in range(_STEPS):
        R, t = _fit(p, q, weight / pair.depth_b**2)
        moved = p @ R.T + t
        # Across the image in pixels, not in meters: these shrink with a growing focal length, and so would the error.
        across = (focal * moved[:, :2] / np.maximum(moved[:, 2:], _NEAREST_M) - pair.b) / _FAR_PX
        along = (moved[:, 2] / pair.depth_b - 1) / _FAR
        squared = (across**2).sum(axis=1) + along**2
        weight = 1 / (1 + squared) ** 2
    return float((squared / (1 + squared)).mean())


def _fit(
    p: NDArray[np.float64], q: NDArray[np.float64], weight: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The rotation and translation that bring (M, 3) p to q with the least weighted squares (Kabsch)."""
    weight = weight / weight.sum()
    mean_p, mean_q = weight @ p, weight @ q
    u, _, vt = np.linalg.svd((q - mean_q).T @ ((p - mean_p) * weight[:, None]))
    R = u @ np.diag((1.0, 1.0, np.linalg.det(u @ vt))) @ vt
    return R, mean_q - R @ mean_p
