"""Estimates from a scan whether color and depth have the same focal length.

Some sensors are calibrated only roughly: the depth image is registered to the color image, but at another scale. Depth
alone gives the motion between two frames. Back-projected features, moved by it, meet their matches only if the color
camera's focal length is right. Of many focal lengths, the one with the least reprojection error is taken if it stands
out; else nothing changes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from . import orb_features
from .measured_pairs import MeasuredPair

_RATIOS = np.exp(np.linspace(np.log(0.8), np.log(1.25), 46))
"""Ratios of the color and depth focal lengths to try: up to a quarter larger or smaller, in steps of 1 %."""

_LEAST_CHANGE = 0.015  # relative change of the focal length; smaller ones are within the accuracy of a scan
_LEAST_GAIN = 0.15  # relative decrease of the error; a clear minimum has more
_LEAST_PAIRS, _LEAST_MATCHES = 8, 500  # the smallest numbers; with fewer, the ratio is 1
_FAR_PX = 3.0  # a match with a larger error counts as wrong


@dataclass(frozen=True)
class ColorFocal:
    """Focal length of the color camera over that of the depth camera; 1 unless the pairs of frames clearly show another
    value. out_of_range: whether the error still falls at the end of what is tried, so that no ratio explains it."""

    ratio: float = 1.0
    out_of_range: bool = False


def fit_color_focal(pairs: Sequence[MeasuredPair]) -> ColorFocal:
    """Compares the focal lengths of color and depth by pairs of frames."""
    if len(pairs) < _LEAST_PAIRS or sum(len(pair.matches) for pair in pairs) < _LEAST_MATCHES:
        return ColorFocal()
    errors = np.array([_error(pairs, ratio) for ratio in _RATIOS])
    unchanged, best = _error(pairs, 1.0), int(np.argmin(errors))
    if errors[best] > (1 - _LEAST_GAIN) * unchanged:
        return ColorFocal()
    if best in (0, len(_RATIOS) - 1):
        return ColorFocal(out_of_range=True)
    a, b, _ = np.polyfit(np.log(_RATIOS[best - 1 : best + 2]), errors[best - 1 : best + 2], 2)
    ratio = float(np.exp(-b / (2 * a)))
    return ColorFocal(ratio) if abs(np.log(ratio)) >= _LEAST_CHANGE else ColorFocal()


def estimate_color_focal(pairs: Sequence[MeasuredPair]) -> float:
    """The ratio of ``fit_color_focal``."""
    return fit_color_focal(pairs).ratio


def _error(pairs: Sequence[MeasuredPair], ratio: float) -> float:
    """Mean saturating reprojection error, 0…1, for a ratio of the focal lengths."""
    total, count = 0.0, 0
    for pair in pairs:
        source, target, T, rows = pair.source, pair.target, pair.T_target_source, pair.matches
        camera = replace(source.camera, fx=source.camera.fx * ratio, fy=source.camera.fy * ratio)
        points = orb_features.lift_rays(source.features.rays(camera), source.view)[rows[:, 0]]
        known = points[:, 2] > 0
        moved = points[known] @ T[:3, :3].T + T[:3, 3]
        off = camera.fx * (moved[:, :2] / moved[:, 2:] - target.features.rays(camera)[rows[known, 1]])
        squared = (off**2).sum(axis=1) / _FAR_PX**2
        total += float((squared / (1 + squared)).sum())
        count += len(squared)
    return total / max(count, 1)
