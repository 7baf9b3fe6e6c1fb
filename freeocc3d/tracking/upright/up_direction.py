"""Estimates which way is up, from how people hold cameras and from floors, tables and ceilings."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_SAMPLES = 20_000
_BIN = 0.05  # meters
_ALL_ALIKE = 0.05
"""Weight of the mean upward axis relative to the cameras' level axes. It is small: this axis decides only where all
cameras look the same way."""
_REACHES_DEG = (10.0, 3.0, 0.8)  # largest turn of up, round after round
_TILTS = 11  # number of tilts to try along each axis
_TINY = 1e-9  # avoids division by 0 where opposite axes cancel out
_SIDEWAYS = 0.4
"""A camera counts as held sideways if the mean of its x axes is longer than that of its y axes by this much. A camera
that nods from floor to ceiling without turning has a difference of 0.36."""


def estimate_up(T_world_cam: NDArray[np.float64], points_world: NDArray[np.floating]) -> NDArray[np.float64]:
    """Returns the (3,) unit vector that points up in the world, from (K, 4, 4) poses and (N, 3) surface points: that of
    ``estimate_camera_up``, turned by ``turn_to_levels``."""
    if len(T_world_cam) == 0:
        return np.array((0.0, -1.0, 0.0))
    return turn_to_levels(estimate_camera_up(T_world_cam)[0], points_world)


def estimate_camera_up(T_world_cam: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
    """Returns the (3,) unit vector that points up in the world, from (K, 4, 4) poses, K > 0, and by how many degrees
    the cameras were rolled about it: the root mean square.

    People pitch cameras freely but hardly roll them, so the x axes are level. Up is the direction in which these axes
    vary least, on the side of -y. If a person held the camera sideways all the time and no metadata says so, the y axes
    are level; the sign then follows from the fact that cameras look down more than up.
    """
    level_axes, mean_up = _held(T_world_cam)
    mean_up /= max(float(np.linalg.norm(mean_up)), _TINY)
    spread = level_axes.T @ level_axes / len(level_axes) + _ALL_ALIKE * (np.eye(3) - np.outer(mean_up, mean_up))
    up = np.linalg.eigh(spread)[1][:, 0]
    up = up if up @ mean_up >= 0 else -up
    rolled = np.arcsin(np.clip(level_axes @ up, -1, 1))
    return up, float(np.degrees(np.sqrt((rolled**2).mean())))


def look_one_way(T_world_cam: NDArray[np.float64]) -> bool:
    """Whether all of (K, 4, 4) cameras, K > 0, look so nearly the same way that their level axes do not tell their
    pitch."""
    level_axes, _ = _held(T_world_cam)
    return bool(np.linalg.eigvalsh(level_axes.T @ level_axes / len(level_axes))[1] < _ALL_ALIKE)


def turn_to_levels(up: NDArray[np.float64], points_world: NDArray[np.floating]) -> NDArray[np.float64]:
    """Returns the (3,) ``up`` turned by up to 10 degrees to where the heights of (N, 3) surface points have the
    sharpest histogram, as on level surfaces."""
    step = max(1, len(points_world) // _SAMPLES)
    points = np.asarray(points_world[::step], np.float64)
    for reach in _REACHES_DEG:
        up = _most_level(up, points, np.deg2rad(reach))
    return up


def turn_back(T_world_cam: NDArray[np.float64], quarters: NDArray[np.integer]) -> NDArray[np.float64]:
    """Returns the (K, 4, 4) poses of the cameras as people held them. quarters: (K,) counter-clockwise quarter turns
    that the images were turned by (``Capture.turned``)."""
    cos, sin = np.array((1, 0, -1, 0))[quarters % 4], np.array((0, -1, 0, 1))[quarters % 4]
    T_cam_held = np.tile(np.eye(4), (len(T_world_cam), 1, 1))
    T_cam_held[:, :2, :2] = np.stack((cos, -sin, sin, cos), axis=-1).reshape(-1, 2, 2)
    return T_world_cam @ T_cam_held


def _held(T_world_cam: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns the (K, 3) level axes of the cameras, and the (3,) mean of the axes that point up: when people turn
    around, this axis stays the same."""
    x_axes, y_axes, forward = (T_world_cam[:, :3, axis] for axis in range(3))
    top, side = -y_axes.mean(axis=0), x_axes.mean(axis=0)
    if float(np.linalg.norm(side)) < float(np.linalg.norm(top)) + _SIDEWAYS:
        return x_axes, top
    return y_axes, side if side @ forward.mean(axis=0) <= 0 else -side


def _most_level(up: NDArray[np.float64], points: NDArray[np.float64], reach: float) -> NDArray[np.float64]:
    """Returns the direction within ``reach`` of ``up``, on an 11 x 11 grid of tilts, with the sharpest histogram of
    heights: the greatest sum of squared counts."""
    if len(points) == 0:
        return up
    a = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    a /= np.linalg.norm(a)
    b = np.cross(up, a)
    tilts = np.stack(np.meshgrid(*[np.linspace(-reach, reach, _TILTS)] * 2), axis=-1).reshape(-1, 2)
    tilts = tilts[np.linalg.norm(tilts, axis=1) <= reach * 1.001]
    directions = up + np.tan(tilts[:, :1]) * a + np.tan(tilts[:, 1:]) * b
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    levels = np.floor((points - points.mean(axis=0)) @ directions.T / _BIN).astype(np.int64)
    levels -= levels.min(axis=0)
    piled = [float((np.bincount(column).astype(np.float64) ** 2).sum()) for column in levels.T]
    return np.asarray(directions[int(np.argmax(piled))])
