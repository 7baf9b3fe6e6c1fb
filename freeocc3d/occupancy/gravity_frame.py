"""Finds the frame that robots plan in: z up, the floor at z = 0, the walls along x and y."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from ..core.transforms import invert
from ..core.types import Gaussians
from .up_direction import estimate_up

_SAMPLES = 20_000
_NEIGHBORS = 24
_FLAT = 0.3  # greatest thickness of flat surroundings, as a share of their width
_LEVEL = np.cos(np.deg2rad(20.0))  # a normal within this angle of up belongs to a level surface
_UPRIGHT = np.sin(np.deg2rad(15.0))  # … and a normal below this to a wall
_BIN = 0.02  # meters
_FLOOR_SHARE = 0.25  # of the largest level surface below the cameras: a smaller surface is not a floor
_BAND = (0.08, 0.05, 0.03)  # meters around the floor: points within them fit the plane, band after band
_LARGEST_TURN = np.deg2rad(3.0)
_BELOW_CAMERA = 0.2  # meters: least height of the camera above the floor
_SMOOTHING = (0.25, 0.5, 1.0, 0.5, 0.25)  # smooths the histogram of heights, so that noise makes no peaks
_LEAST_FLOOR = 10  # smallest number of points for the floor's plane
_NEAR_PEAK_DEG = 3.0  # largest angle from the peak of the walls' directions for the median
_STEEP = 0.95  # cosine, 18 degrees: a camera nearer to straight down or up has no heading
_EXTENT = 0.5
"""Meters: least standard deviation of a floor's points along its narrow side; a narrower floor shows no tilt."""


def estimate_gravity_frame(T_map_cam: NDArray[np.float64], gaussians: Gaussians) -> NDArray[np.float64]:
    """Returns the (4, 4) rigid ``T_gravity_map``: z up, z = 0 on the floor, x = y = 0 below the first camera, x along
    the walls in the direction nearest to that camera's view.

    T_map_cam: (K, 4, 4) poses of the keyframes. The floor is the lowest of the large level surfaces below the cameras.
    Without such a surface, z = 0 is the level of the lowest surface points. Without walls, x is the first camera's view
    direction.
    """
    if len(T_map_cam) == 0:
        T_map_cam = np.eye(4)[None]
    up = estimate_up(T_map_cam, gaussians.means)
    points, normals = _planes(gaussians.means)
    cameras = T_map_cam[:, :3, 3]
    level = points[np.abs(normals @ up) > _LEVEL]
    height = estimate_floor_height(level @ up, float(np.median(cameras @ up)))
    if height is None:
        lowest = gaussians.means @ up.astype(np.float32) if len(gaussians) else cameras @ up
        height = float(np.percentile(lowest, 1))
    else:
        up, height = _fitted(up, height, level)
    x = _along_walls(up, T_map_cam[0, :3, 2], -T_map_cam[0, :3, 1], normals)
    R = np.stack((x, np.cross(up, x), up))
    T_gravity_map = np.eye(4)
    T_gravity_map[:3, :3] = R
    T_gravity_map[:3, 3] = (*(-R[:2] @ cameras[0]), -height)
    return T_gravity_map


def is_floor_seen(T_gravity_map: NDArray[np.float64], T_map_cam: NDArray[np.float64], gaussians: Gaussians) -> bool:
    """Whether z = 0 of ``estimate_gravity_frame`` is a floor, and not just the level of the lowest points."""
    points, normals = _planes(gaussians.means)
    up = T_gravity_map[2, :3]
    level = (points @ up + T_gravity_map[2, 3])[np.abs(normals @ up) > _LEVEL]
    cameras = T_map_cam[:, :3, 3] @ up + T_gravity_map[2, 3]
    height = estimate_floor_height(level, float(np.median(cameras))) if len(cameras) else None
    return height is not None and abs(height) < 2 * _BAND[0]


def compute_first_camera_frame(
    T_gravity_map: NDArray[np.float64], T_map_cam: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Returns the (4, 4) rigid ``T_first_map``: z up, the origin at the center of the camera ``T_map_cam`` (4, 4), x
    along its view. Robots use the same convention for their start."""
    T_gravity_cam = T_gravity_map @ T_map_cam
    x = _heading(np.array((0.0, 0.0, 1.0)), T_gravity_cam[:3, 2], -T_gravity_cam[:3, 1])
    T_gravity_first = np.eye(4)
    T_gravity_first[:3, :3] = np.stack((x, (-x[1], x[0], 0.0), (0.0, 0.0, 1.0)), axis=1)
    T_gravity_first[:3, 3] = T_gravity_cam[:3, 3]
    return np.asarray(invert(T_gravity_first) @ T_gravity_map)


def estimate_floor_height(heights: NDArray[np.float64], camera_height: float) -> float | None:
    """Returns the height of the floor from the (N,) heights of points on level surfaces. It is the lowest peak of their
    histogram below the cameras with at least a quarter of the largest peak's points. None without points there."""
    below = heights[heights < camera_height - _BELOW_CAMERA]
    if not len(below):
        return None
    low = float(below.min())
    count = np.bincount(((below - low) / _BIN).astype(np.int64), minlength=3).astype(np.float64)
    smooth = np.convolve(count, _SMOOTHING, "same")
    padded = np.pad(smooth, 1)
    is_peak = (smooth >= padded[:-2]) & (smooth >= padded[2:]) & (smooth >= _FLOOR_SHARE * smooth.max())
    return low + (int(np.flatnonzero(is_peak)[0]) + 0.5) * _BIN


def _fitted(up: NDArray[np.float64], height: float, level: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
    """Returns up and the floor's height from a least-squares plane through the points near the floor, in ever narrower
    bands. Up stays as it is where the points do not spread in both directions or would turn it by more than 3 degrees.
    """
    normal = up
    for band in _BAND:
        near = level[np.abs(level @ normal - height) < band]
        if len(near) < _LEAST_FLOOR:
            return up, height
        center = near.mean(axis=0)
        spread, axes = np.linalg.eigh(np.cov((near - center).T))
        fitted = axes[:, 0] * np.sign(axes[:, 0] @ up)
        if spread[1] > _EXTENT**2 and fitted @ up > np.cos(_LARGEST_TURN):
            normal = fitted
        height = float(center @ normal)
    return normal, height


def _along_walls(
    up: NDArray[np.float64], forward: NDArray[np.float64], above: NDArray[np.float64], normals: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Returns the (3,) level unit vector along the walls that is nearest to ``forward``. It comes from the peak of the
    walls' normals, folded into a quarter turn."""
    x = _heading(up, forward, above)
    walls = normals[np.abs(normals @ up) < _UPRIGHT]
    if not len(walls):
        return x
    quarter = np.degrees(np.arctan2(walls @ np.cross(up, x), walls @ x)) % 90.0
    count = np.bincount(quarter.astype(np.int64) % 90, minlength=90)
    piled = sum(np.roll(count, shift) for shift in range(-2, 3))
    peak = int(np.argmax(piled)) + 0.5
    off = (quarter - peak + 45.0) % 90.0 - 45.0
    turn = np.deg2rad((peak + float(np.median(off[np.abs(off) < _NEAR_PEAK_DEG])) + 45.0) % 90.0 - 45.0)
    return np.asarray(np.cos(turn) * x + np.sin(turn) * np.cross(up, x))


def _heading(up: NDArray[np.float64], forward: NDArray[np.float64], above: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns the (3,) level unit vector along a camera's view. If the camera looks straight down or up, it points to
    the top or bottom edge of its image."""
    looks = forward if abs(forward @ up) < _STEEP else above * -np.sign(forward @ up)
    flat = looks - (looks @ up) * up
    return np.asarray(flat / np.linalg.norm(flat))


def _planes(means: NDArray[np.float32]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns (P, 3) points that lie on something flat, from a sample spread evenly over storage, and the (P, 3)
    normals of planes through their neighbors. Gaussians have no normals: by default they are spheres."""
    if len(means) < _NEIGHBORS:
        return np.zeros((0, 3)), np.zeros((0, 3))
    points = means[:: max(1, len(means) // _SAMPLES)].astype(np.float64)
    near = means[KDTree(means).query(points, _NEIGHBORS)[1]].astype(np.float64)
    off = near - near.mean(axis=1, keepdims=True)
    spread, axes = np.linalg.eigh(np.einsum("pki,pkj->pij", off, off))
    flat = spread[:, 0] < _FLAT**2 * spread[:, 1]
    return points[flat], axes[flat, :, 0]
