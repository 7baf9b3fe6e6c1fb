"""Estimates from a scan whether color and depth have the same focal length.

Some sensors are calibrated only roughly: the depth image is registered to the color image, but at another scale. Depth
alone gives the motion between two frames. Back-projected features, moved by it, meet their matches only if the color
camera's focal length is right. Of many focal lengths, the one with the least reprojection error is taken if it stands
out; else nothing changes.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ...capture.base import Capture
from ...core.threads import count_threads
from ...core.transforms import measure_pose_difference
from . import dense_alignment, orb_features
from .keyframe_registration import KeyframeView, decode_keyframe_view, match_keyframes

PAIRS = 36
"""Number of pairs of frames to compare."""

_GAPS = (24, 12, 6, 3)
"""Frames between the two of a pair, those that are tried first first: the longer the way, the more it tells."""

_RATIOS = np.exp(np.linspace(np.log(0.8), np.log(1.25), 46))
"""Ratios of the color and depth focal lengths to try: up to a quarter larger or smaller, in steps of 1 %."""

_PAIR_PX = 6.0  # largest reprojection error of a match: twice the usual one, because the focal length may be wrong
_PAIR_OVERLAP, _PAIR_INLIERS = 0.6, 0.75  # smallest overlap of a pair, and share of it on the other's surface
_PAIR_MOVED = 0.02  # meters or degrees: without motion, the focal length has no effect
_LEAST_CHANGE = 0.015  # relative change of the focal length; smaller ones are within the accuracy of a scan
_LEAST_GAIN = 0.15  # relative decrease of the error; a clear minimum has more
_LEAST_PAIRS, _LEAST_MATCHES = 8, 500  # the smallest numbers; with fewer, the ratio is 1
_FAR_PX = 3.0  # a match with a larger error counts as wrong


def estimate_color_focal(capture: Capture, frames: range) -> float:
    """Focal length of the color camera over that of the depth camera; 1 unless the scan clearly shows another value.

    frames: the selected frames of the capture. Does not read poses.
    """
    pairs = _pairs(capture, frames)
    if len(pairs) < _LEAST_PAIRS or sum(len(rows) for _, _, _, rows in pairs) < _LEAST_MATCHES:
        return 1.0
    errors = np.array([_error(pairs, ratio) for ratio in _RATIOS])
    unchanged, best = _error(pairs, 1.0), int(np.argmin(errors))
    if best in (0, len(_RATIOS) - 1) or errors[best] > (1 - _LEAST_GAIN) * unchanged:
        return 1.0
    a, b, _ = np.polyfit(np.log(_RATIOS[best - 1 : best + 2]), errors[best - 1 : best + 2], 2)
    ratio = float(np.exp(-b / (2 * a)))
    return ratio if abs(np.log(ratio)) >= _LEAST_CHANGE else 1.0


_Pair = tuple[KeyframeView, KeyframeView, NDArray[np.float64], NDArray[np.int64]]


def _pairs(capture: Capture, frames: range) -> list[_Pair]:
    """Pairs of frames (source, target), the source's pose in the target from depth alone, and their (M, 2) matches."""
    starts = np.unique(np.linspace(0, max(len(frames) - 1, 0), PAIRS, dtype=int))
    with ThreadPoolExecutor(count_threads()) as pool:
        found = pool.map(lambda start: _pair(capture, frames[start:]), starts.tolist())
        return [pair for pair in found if pair is not None]


def _pair(capture: Capture, frames: range) -> _Pair | None:
    """The first frame and the farthest of a few later frames that still overlaps most of it."""
    target = decode_keyframe_view(capture, frames[0])
    for gap in _GAPS:
        source = decode_keyframe_view(capture, frames[gap]) if target is not None and gap < len(frames) else None
        if target is None or source is None:
            continue
        found = match_keyframes(source, target)
        guess = orb_features.estimate_pose(found.points_s, found.rays_t, 1.0 / target.camera.fx, threshold_px=_PAIR_PX)
        if guess is None:
            continue
        aligned = dense_alignment.align_views(source.view, target.view, guess[0], photometric=0.0)
        moved = max(measure_pose_difference(np.eye(4), aligned.T_target_source))
        alike = aligned.determined and aligned.overlap > _PAIR_OVERLAP and aligned.inliers > _PAIR_INLIERS
        if alike and moved > _PAIR_MOVED:
            return source, target, aligned.T_target_source, orb_features.match_binary(source.features, target.features)
    return None


def _error(pairs: list[_Pair], ratio: float) -> float:
    """Mean saturating reprojection error, 0…1, for a ratio of the focal lengths."""
    total, count = 0.0, 0
    for source, target, T, rows in pairs:
        camera = replace(source.camera, fx=source.camera.fx * ratio, fy=source.camera.fy * ratio)
        points = orb_features.lift_rays(source.features.rays(camera), source.view)[rows[:, 0]]
        known = points[:, 2] > 0
        moved = points[known] @ T[:3, :3].T + T[:3, 3]
        off = camera.fx * (moved[:, :2] / moved[:, 2:] - target.features.rays(camera)[rows[known, 1]])
        squared = (off**2).sum(axis=1) / _FAR_PX**2
        total += float((squared / (1 + squared)).sum())
        count += len(squared)
    return total / max(count, 1)
