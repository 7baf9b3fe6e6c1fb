"""Cameras that look at a scene from above, from a corner, from all around, and from one place towards another."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ..core.transforms import invert
from ..core.types import Intrinsics
from .scene_rendering import DrawnScene, ViewCamera

VIEWS = ("above", "corner")

_FAR = 300.0  # a camera of a parallel projection is so many times the scene's size away
_ELEVATION = math.radians(45.0)
_AWAY = 4.0  # distance of a camera that goes around the scene, in radii of the scene
_WIDE = 0.6  # focal length of a camera inside a room over the width of the picture: 80 degrees
_STEEP = 0.999

Vector = NDArray[np.float64]


def aim(scene: DrawnScene, view: str, size: tuple[int, int]) -> ViewCamera:
    """Returns the camera of one of ``VIEWS``: straight above, or down into the scene from the corner nearest to the
    camera path. All boxes and all but a few stray voxels fill the view. Both views are parallel projections: equal
    lengths look equal. size: (W, H) pixels."""
    points, path = scene.vertices, scene.path
    middle = _middle(points)
    if view == "above":
        back, up = np.array((0.0, 0.0, 1.0)), np.array((0.0, 1.0, 0.0))
    else:
        towards = (path.mean(axis=0) - middle)[:2] if len(path) else np.array((-1.0, -1.0))
        back, up = np.array((*np.where(towards >= 0, 0.6, -0.6), 1.0)), np.array((0.0, 0.0, 1.0))
    axes = _axes(-back, up) * ((1.0,), (-1.0,), (1.0,))  # right, up in the picture, forward
    low, high = _bounds((points - middle) @ axes[:2].T, scene)
    for box in scene.boxes:  # the view holds what a word asks for, however far away it is
        at = (box.corners - middle) @ axes[:2].T
        low, high = np.minimum(low, at.min(axis=0)), np.maximum(high, at.max(axis=0))
    half = 0.5 * (high - low)
    focus = middle + 0.5 * (low + high) @ axes[:2]
    half_height = 1.1 * max(half[1], half[0] * size[1] / size[0], 1e-3)
    distance = _FAR * max(float(np.linalg.norm(np.ptp(points, axis=0))), half_height)
    focal = 0.5 * size[1] * distance / half_height
    return _camera(focus - distance * axes[2], axes[2], up, size, focal, distance)


def aim_around(scene: DrawnScene, size: tuple[int, int], count: int) -> list[ViewCamera]:
    """Returns ``count`` cameras that go once around the scene, all at the same distance and looking down at its middle
    at 45 degrees. size: (W, H) pixels."""
    middle = _middle(scene.vertices)
    reach = scene.vertices - middle
    radius = float(np.percentile(np.hypot(reach[:, 0], reach[:, 1]), 99))
    half_z = float(np.percentile(np.abs(reach[:, 2]), 99))
    for box in scene.boxes:
        radius = max(radius, float(np.hypot(*(box.corners - middle)[:, :2].T).max()))
    half_height = radius * math.sin(_ELEVATION) + half_z * math.cos(_ELEVATION)
    distance = _AWAY * max(radius, half_z)
    nearest = 1 - radius * math.cos(_ELEVATION) / distance  # what is near looks larger
    focal = 0.5 * distance * min(size[0] / max(radius, 1e-3), size[1] * nearest / max(half_height, 1e-3)) / 1.04
    cameras = []
    for turn in 2 * math.pi * np.arange(count) / count:
        flat = math.cos(_ELEVATION) * np.array((math.sin(turn), -math.cos(turn)))
        back = np.array((*flat, math.sin(_ELEVATION)))
        cameras.append(_camera(middle + distance * back, -back, np.array((0.0, 0.0, 1.0)), size, focal))
    return cameras


def aim_from(place: Vector, target: Vector, size: tuple[int, int]) -> ViewCamera:
    """Returns the camera at ``place`` that looks towards another place, (3,) in the scene's frame, 80 degrees wide. Up
    is z; for a look straight up or down it is y. size: (W, H) pixels."""
    forward = (target - place) / np.linalg.norm(target - place)
    up = np.array((0.0, 1.0, 0.0) if abs(forward[2]) > _STEEP else (0.0, 0.0, 1.0))
    return _camera(place, forward, up, size, _WIDE * size[0])


def pixels_of(points: NDArray[np.float64], camera: ViewCamera) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns the (N, 2) pixels and the (N,) depths of (N, 3) places; those behind the camera have no meaning."""
    x, y, z = (points @ camera.T_cam_scene[:3, :3].T + camera.T_cam_scene[:3, 3]).T
    pinhole = camera.intrinsics
    safe = np.where(z > 0, z, 1.0)
    return np.stack((pinhole.fx * x / safe + pinhole.cx, pinhole.fy * y / safe + pinhole.cy), axis=1), z


def _camera(
    position: Vector, forward: Vector, up: Vector, size: tuple[int, int], focal: float, distance: float | None = None
) -> ViewCamera:
    T_scene_cam = np.eye(4)
    T_scene_cam[:3, :3] = _axes(forward, up).T
    T_scene_cam[:3, 3] = position
    width, height = size
    pinhole = Intrinsics(width, height, focal, focal, 0.5 * (width - 1), 0.5 * (height - 1))
    return ViewCamera(invert(T_scene_cam), pinhole, distance)


def _axes(forward: Vector, up: Vector) -> NDArray[np.float64]:
    """Returns the (3, 3) right, down and forward unit vectors, in rows."""
    ahead = forward / np.linalg.norm(forward)
    right = np.cross(ahead, up)
    right /= np.linalg.norm(right)
    return np.stack((right, np.cross(ahead, right), ahead))


def _middle(points: NDArray[np.float64]) -> Vector:
    return np.asarray(0.5 * (np.percentile(points, 1, axis=0) + np.percentile(points, 99, axis=0)))


def _bounds(spread: NDArray[np.float64], scene: DrawnScene) -> tuple[NDArray[np.float64], ...]:
    """Returns the (2,) lower and (2,) upper bounds of the scene's faces in the view, without 0.3 % of their area on
    each side; the bounds of its points if it has no faces. spread: the vertices in the view."""
    weights = np.ones(len(spread))
    if len(scene.quads):
        corners = scene.vertices.reshape(-1, 4, 3)
        weights = np.repeat(((corners[:, 2] - corners[:, 0]) ** 2).sum(axis=1), 4)
    order = np.argsort(spread, axis=0)
    up_to = np.cumsum(weights[order], axis=0)
    ends = (np.count_nonzero(up_to < share * up_to[-1], axis=0) for share in (0.003, 0.997))
    return tuple(np.take_along_axis(spread, np.take_along_axis(order, end[None], 0), 0)[0] for end in ends)
