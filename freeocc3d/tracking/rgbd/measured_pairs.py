"""Pairs of frames whose relative motion depth alone measures. What a capture states is compared with them: the focal
length of its color camera, its poses, its intrinsics."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...capture.base import Capture
from ...core.sampling import spread_evenly
from ...core.threads import count_threads
from ...core.transforms import measure_pose_difference
from . import dense_alignment, orb_features
from .keyframe_registration import KeyframeView, decode_keyframe_view, match_keyframes

PAIRS = 36
"""Number of pairs of frames to measure."""

_GAPS = (24, 12, 6, 3)
"""Frames between the two of a pair, those that are tried first first: the longer the way, the more it tells."""

_SHORT_SCAN, _SHORT_GAPS = 60, (12, 6, 3, 2, 1)
"""Scans of fewer frames are often thinned out, so that neighbors are far apart."""

_PAIR_PX = 6.0  # largest reprojection error of a match: twice the usual one, because the focal length may be wrong
_PAIR_OVERLAP, _PAIR_INLIERS = 0.6, 0.75  # smallest overlap of a pair, and share of it on the other's surface
_PAIR_MOVED = 0.02  # meters or degrees: without motion, nothing can be compared


@dataclass(frozen=True)
class MeasuredPair:
    """Two frames of a capture, T_target_source (4, 4) from their depth alone, meters, and their (M, 2) matched
    features."""

    source_index: int
    target_index: int
    source: KeyframeView
    target: KeyframeView
    T_target_source: NDArray[np.float64]
    matches: NDArray[np.int64]


def measure_pairs(capture: Capture, frames: range) -> list[MeasuredPair]:
    """Pairs of frames, spread over the selected frames of a capture. Does not read poses."""
    starts = spread_evenly(len(frames), PAIRS)
    gaps = _GAPS if len(frames) >= _SHORT_SCAN else _SHORT_GAPS
    with ThreadPoolExecutor(count_threads()) as pool:
        found = pool.map(lambda start: _measure(capture, frames[start:], gaps), starts)
        return [pair for pair in found if pair is not None]


def _measure(capture: Capture, frames: range, gaps: tuple[int, ...]) -> MeasuredPair | None:
    """The first frame and the farthest of a few later frames that still overlaps most of it."""
    target = decode_keyframe_view(capture, frames[0])
    for gap in gaps:
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
            rows = orb_features.match_binary(source.features, target.features)
            return MeasuredPair(frames[gap], frames[0], source, target, aligned.T_target_source, rows)
    return None
