"""Triangulates sparse points of a scan with known poses, from features matched between frames."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from ..capture import read_ahead
from ..capture.base import Capture
from ..core.errors import FrameError
from ..core.progress import Progress
from ..core.types import Frame
from ..tracking.base import PosedPoints
from ..tracking.rgbd import orb_features

_STEPS = (1, 2, 3, 5, 8, 12)  # frames ahead
_NEAR = 6  # frames from other times with a nearby camera and a similar direction
_LOOK = 0.8  # smallest cosine between optical axes
_LEAST_ANGLE = np.radians(2.0)
_AGREES = 2.0 / 500.0  # of a ray's length: largest gap between the rays of one point


def triangulate(
    capture: Capture,
    T_world_cam: NDArray[np.float64],
    frames: Sequence[int],
    progress: Progress,
    prepared: Callable[[Frame], Frame] = lambda frame: frame,
) -> PosedPoints:
    """Triangulate points that pairs of ``frames`` see. T_world_cam: (N, 4, 4), NaN where unknown."""
    posed = [frame for frame in frames if np.isfinite(T_world_cam[frame]).all()]
    progress.stage("triangulation", len(posed))
    found: dict[int, tuple[orb_features.OrbFeatures, NDArray[np.float64]]] = {}
    for done, (index, frame) in enumerate(read_ahead(capture, posed), start=1):
        if not isinstance(frame, FrameError):
            frame = prepared(frame)
            detected = orb_features.detect_features(frame)
            rays = detected.rays(frame.intrinsics).astype(np.float64)
            directions = np.concatenate((rays, np.ones((len(rays), 1))), axis=1) @ T_world_cam[index, :3, :3].T
            found[index] = detected, directions / np.linalg.norm(directions, axis=1, keepdims=True)
        progress.advance(done)
    points, seen_frame, seen_point, count = [], [], [], 0
    for a, b in _pairs(T_world_cam, list(found)):
        rows = orb_features.match_binary(found[a][0], found[b][0])
        met = _meeting(T_world_cam[a, :3, 3], found[a][1][rows[:, 0]], T_world_cam[b, :3, 3], found[b][1][rows[:, 1]])
        points.append(met)
        seen_frame += [np.full(len(met), a), np.full(len(met), b)]
        seen_point += [count + np.arange(len(met))] * 2
        count += len(met)
    return PosedPoints(
        T_world_cam,
        np.concatenate([np.zeros((0, 3)), *points]).astype(np.float32),
        np.concatenate([np.zeros(0), *seen_frame]).astype(np.int32),
        np.concatenate([np.zeros(0), *seen_point]).astype(np.int32),
    )


def _pairs(T_world_cam: NDArray[np.float64], frames: list[int]) -> list[tuple[int, int]]:
    """Pairs of frames that may overlap: successive ones, and nearby ones with a similar direction."""
    T = T_world_cam[frames]
    pairs = {(row, row + step) for step in _STEPS for row in range(len(frames) - step)}
    for row in range(len(frames)):
        distance = np.linalg.norm(T[:, :3, 3] - T[row, :3, 3], axis=1)
        other = (T[:, :3, 2] @ T[row, :3, 2] > _LOOK) & (np.abs(np.arange(len(frames)) - row) > _STEPS[-1])
        near = np.flatnonzero(other)
        near = near[np.argsort(distance[near])[:: max(1, len(near) // _NEAR)]][:_NEAR]  # some near, some farther away
        pairs |= {(min(row, k), max(row, k)) for k in near.tolist()}
    return [(frames[a], frames[b]) for a, b in sorted(pairs)]


def _meeting(
    center_a: NDArray[np.float64],
    rays_a: NDArray[np.float64],
    center_b: NDArray[np.float64],
    rays_b: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Midpoints between (M, 3) unit rays of two cameras, for the pairs that meet in front of both cameras."""
    way = center_b - center_a
    cosine = np.einsum("mc,mc->m", rays_a, rays_b)
    sine2 = np.maximum(1.0 - cosine**2, 1e-12)
    along_a, along_b = rays_a @ way, rays_b @ way
    a, b = (along_a - cosine * along_b) / sine2, (cosine * along_a - along_b) / sine2
    on_a, on_b = center_a + a[:, None] * rays_a, center_b + b[:, None] * rays_b
    gap = np.linalg.norm(on_a - on_b, axis=1)
    good = (a > 0) & (b > 0) & (sine2 > np.sin(_LEAST_ANGLE) ** 2) & (gap < _AGREES * np.minimum(a, b))
    return np.asarray(0.5 * (on_a + on_b)[good])
