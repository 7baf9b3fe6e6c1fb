"""Chooses the views that measure a view's depth best: those that see the same points from some degrees apart."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

_LEAST_WEIGHT = 3.0  # in points seen at the best angle
_MARGIN = 0.7, 1.6  # extends the depth range of the points, for surfaces without texture
_OUTLIERS = 2.0  # percent of the points at either end
_LEAST_POINTS = 20


class ViewAngles(NamedTuple):
    """Angle between the rays of a point, degrees: the best one, and standard deviations below and above it."""

    best: float
    below: float
    above: float


ALIKE = ViewAngles(8.0, 3.0, 8.0)
"""The images still look alike: for finding matches."""

APART = ViewAngles(14.0, 6.0, 10.0)
"""Depth is more accurate: for refining matches that are known to a pixel or two."""


@dataclass(frozen=True)
class SelectedViews:
    """The views to compare. partners: per frame, indices of the views to compare it with, the best first; may be empty.
    near, far: (N,) depth range of each frame, meters."""

    partners: list[NDArray[np.int64]]
    near: NDArray[np.float64]
    far: NDArray[np.float64]


def select_partners(
    T_world_cam: NDArray[np.float64],
    points: NDArray[np.float32],
    seen_frame: NDArray[np.int32],
    seen_point: NDArray[np.int32],
    count: int,
    angles: ViewAngles = ALIKE,
) -> SelectedViews:
    """Choose up to ``count`` partners of each frame.

    T_world_cam: (N, 4, 4), NaN where unknown.  points: (P, 3) world.  seen_frame, seen_point: (O,) frame
    ``seen_frame[o]`` sees point ``seen_point[o]``. The weight of a point that two frames share depends on the angle
    between its rays and on the ratio of its distances.
    Source: J. Schönberger et al., Pixelwise View Selection for Unstructured Multi-View Stereo, ECCV 2016.
    """
    frames = len(T_world_cam)
    order = np.argsort(seen_point, kind="stable")
    by_point = seen_frame[order]
    starts = np.searchsorted(seen_point[order], np.arange(len(points) + 1))
    centers, forward = T_world_cam[:, :3, 3], T_world_cam[:, :3, 2]
    depths = np.einsum("oc,oc->o", points[seen_point] - centers[seen_frame], forward[seen_frame])
    depths = np.where(np.isfinite(depths) & (depths > 0), depths, np.nan)
    overall = (
        np.nanpercentile(depths, (_OUTLIERS, 100 - _OUTLIERS)) if np.isfinite(depths).any() else np.full(2, np.nan)
    )
    near, far = np.full(frames, overall[0]), np.full(frames, overall[1])
    partners = []
    by_frame = np.argsort(seen_frame, kind="stable")
    bounds = np.searchsorted(seen_frame[by_frame], np.arange(frames + 1))
    for frame in range(frames):
        rows = by_frame[bounds[frame] : bounds[frame + 1]]
        rows = rows[np.isfinite(depths[rows])]
        if len(rows) >= _LEAST_POINTS:
            near[frame], far[frame] = np.percentile(depths[rows], (_OUTLIERS, 100 - _OUTLIERS))
        seen = seen_point[rows]
        lengths = starts[seen + 1] - starts[seen]
        point = np.repeat(seen, lengths)
        first = np.repeat(starts[seen], lengths)
        other = by_point[first + np.arange(len(point)) - np.repeat(np.cumsum(lengths) - lengths, lengths)]
        to_here, to_other = points[point] - centers[frame], points[point] - centers[other]
        here, there = np.linalg.norm(to_here, axis=1), np.linalg.norm(to_other, axis=1)
        angle = np.degrees(np.arccos(np.clip(np.einsum("pc,pc->p", to_here, to_other) / (here * there), -1.0, 1.0)))
        width = np.where(angle < angles.best, angles.below, angles.above)
        weight = np.exp(-0.5 * ((angle - angles.best) / width) ** 2) * np.minimum(here / there, there / here)
        weight = np.where((other != frame) & np.isfinite(weight), weight, 0.0)
        score = np.bincount(other, weight, frames)
        ranked = np.argsort(-score, kind="stable")[:count]
        partners.append(ranked[score[ranked] >= _LEAST_WEIGHT])
    return SelectedViews(partners, near * _MARGIN[0], far * _MARGIN[1])
