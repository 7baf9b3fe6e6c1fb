"""Chooses the frames of a long scan to reconstruct: sharp ones with equal image motion between them."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from ...capture import read_ahead
from ...capture.base import Capture
from ...core.errors import FrameError
from ...core.progress import Progress

_WIDTH = 320  # motion and sharpness are measured in images of this width
_CORNERS, _CORNER_QUALITY, _CORNER_DISTANCE = 150, 0.01, 8
"""Largest number of corners; smallest strength relative to the strongest; smallest distance between two, pixels."""

_LEAST_FOLLOWED, _LEAST_FOLLOWED_SHARE = 20, 0.3  # smallest number and share of tracked corners; below, tracking fails
_LOST = 0.25  # of the width: the motion that counts if tracking fails
_ASTRAY_PX = 1.0  # largest error of a corner that is tracked forth and back
_CREEP = 1e-4  # of the width: least motion, so that a resting camera advances too


def choose_frames(capture: Capture, frames: Sequence[int], budget: int, progress: Progress) -> list[int]:
    """Choose at most ``budget`` of the frames, ascending; all if there are no more. A choice leaves out frames that do
    not decode."""
    if len(frames) <= budget:
        return list(frames)
    progress.stage("selection", len(frames))
    indices, sharp, moved = [], [], []
    before: NDArray[np.uint8] | None = None
    for done, (index, frame) in enumerate(read_ahead(capture, frames), 1):
        if not isinstance(frame, FrameError):
            image = _small(frame.color)
            indices.append(index)
            sharp.append(measure_sharpness(image))
            moved.append(0.0 if before is None else measure_motion(before, image))
            before = image
        progress.advance(done)
    return [indices[row] for row in spread_frames(np.array(sharp), np.array(moved), budget)]


def spread_frames(sharp: NDArray[np.float64], moved: NDArray[np.float64], budget: int) -> list[int]:
    """Choose rows of N frames: cut the total motion into ``budget`` equal parts, and take the sharpest frame of each.

    sharp: (N,) sharpness.  moved: (N,) motion from the frame before."""
    way = np.cumsum(np.maximum(moved, _CREEP))
    part = np.minimum((way - way[0]) / max(way[-1] - way[0], 1e-12) * budget, budget - 1).astype(np.int64)
    order = np.lexsort((-sharp, part))
    _, first = np.unique(part[order], return_index=True)
    return sorted(order[first].tolist())


def measure_sharpness(gray: NDArray[np.uint8]) -> float:
    """Variance of the Laplacian: higher for crisp edges."""
    return float(cv2.Laplacian(gray, cv2.CV_32F).var())


def measure_motion(before: NDArray[np.uint8], after: NDArray[np.uint8]) -> float:
    """Median motion of corners from one (H, W) gray image to the next, as a share of the width."""
    corners = cv2.goodFeaturesToTrack(before, _CORNERS, _CORNER_QUALITY, _CORNER_DISTANCE)
    if corners is None or len(corners) < _LEAST_FOLLOWED:
        return _LOST
    followed, found, _ = cv2.calcOpticalFlowPyrLK(before, after, corners, None)
    back, returned, _ = cv2.calcOpticalFlowPyrLK(after, before, followed, None)
    astray = np.linalg.norm((back - corners).reshape(-1, 2), axis=1)
    found = (found.ravel() == 1) & (returned.ravel() == 1) & (astray < _ASTRAY_PX)
    if found.sum() < max(_LEAST_FOLLOWED, _LEAST_FOLLOWED_SHARE * len(corners)):
        return _LOST
    way = np.linalg.norm((followed - corners).reshape(-1, 2)[found], axis=1)
    return min(float(np.median(way)) / before.shape[1], _LOST)


def _small(color: NDArray[np.uint8]) -> NDArray[np.uint8]:
    gray = cv2.cvtColor(color, cv2.COLOR_RGB2GRAY)
    if gray.shape[1] <= _WIDTH:
        return gray
    height = max(round(gray.shape[0] * _WIDTH / gray.shape[1]), 1)
    return cv2.resize(gray, (_WIDTH, height), interpolation=cv2.INTER_AREA)
