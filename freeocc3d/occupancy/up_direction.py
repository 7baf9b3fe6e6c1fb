"""Which way is up, from how people hold cameras and from floors, tables and ceilings."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_SAMPLES = 20_000
_BIN = 0.05  # meters
_SIDEWAYS = 0.4
"""By how much more of its length the mean of the cameras' x axes has to keep than that of their y axes before a camera
counts as held sideways: one that nods from floor to ceiling without turning keeps 0.36 more."""


def estimate_up(T_world_cam: NDArray[np.float64], points_world: NDArray[np.floating]) -> NDArray[np.float64]:
    """(3,) unit vector that points up in the world, from (K, 4, 4) poses and (N, 3) surface points.

    Cameras are pitched freely but hardly rolled, so that their x axes are level: up is the direction in which these
    axes vary least, and on the side of -y. Where a camera was held sideways all the time and nothing said so, its y
    axes are level, and it looked rather down than up. Up is then turned, by 10 degrees at the most, to where the
    heights of the surface points pile up most, as those of level surfaces do.
    """
    if len(T_world_cam) == 0:
        return np.array((0.0, -1.0, 0.0))
    level_axes, mean_up = _held(T_world_cam)
    mean_up /= max(float(np.linalg.norm(mean_up)), 1e-9)
    # The mean upward axis, weakly, decides where all cameras look the same way.
    spread = level_axes.T @ level_axes / len(level_axes) + 0.05 * (np.eye(3) - np.outer(mean_up, mean_up))
    up = np.linalg.eigh(spread)[1][:, 0]
    up = up if up @ mean_up >= 0 else -up
    step = max(1, len(points_world) // _SAMPLES)
    points = np.asarray(points_world[::step], np.float64)
    for reach in (10.0, 3.0, 0.8):
        up = _most_level(up, points, np.deg2rad(reach))
    return up


def turn_back(T_world_cam: NDArray[np.float64], quarters: NDArray[np.integer]) -> NDArray[np.float64]:
    """(K, 4, 4) poses of the same cameras as they were held, whose images are turned counter-clockwise by (K,) quarter
    turns (``Capture.turned``)."""
    cos, sin = np.array((1, 0, -1, 0))[quarters % 4], np.array((0, -1, 0, 1))[quarters % 4]
    T_cam_held = np.tile(np.eye(4), (len(T_world_cam), 1, 1))
    T_cam_held[:, :2, :2] = np.stack((cos, -sin, sin, cos), axis=-1).reshape(-1, 2, 2)
    return T_world_cam @ T_cam_held


def _held(T_world_cam: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(K, 3) the cameras' axes that are level, and (3,) the mean of those that point up: of people who turn around, the
    axis that stays what it is."""
    x_axes, y_axes, forward = (T_world_cam[:, :3, axis] for axis in range(3))
    top, side = -y_axes.mean(axis=0), x_axes.mean(axis=0)
    if float(np.linalg.norm(side)) < float(np.linalg.norm(top)) + _SIDEWAYS:
        return x_axes, top
    return y_axes, side if side @ forward.mean(axis=0) <= 0 else -side


def _most_level(up: NDArray[np.float64], points: NDArray[np.float64], reach: float) -> NDArray[np.float64]:
    """The direction within ``reach`` of ``up``, on a 11 x 11 grid of tilts, along which heights pile up most: where the
    sum of the squared counts of their histogram is greatest."""
    if len(points) == 0:
        return up
    a = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    a /= np.linalg.norm(a)
    b = np.cross(up, a)
    tilts = np.stack(np.meshgrid(*[np.linspace(-reach, reach, 11)] * 2), axis=-1).reshape(-1, 2)
    tilts = tilts[np.linalg.norm(tilts, axis=1) <= reach * 1.001]
    directions = up + np.tan(tilts[:, :1]) * a + np.tan(tilts[:, 1:]) * b
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    levels = np.floor((points - points.mean(axis=0)) @ directions.T / _BIN).astype(np.int64)
    levels -= levels.min(axis=0)
    piled = [float((np.bincount(column).astype(np.float64) ** 2).sum()) for column in levels.T]
    return np.asarray(directions[int(np.argmax(piled))])
