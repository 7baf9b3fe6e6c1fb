"""Flat patches of what depth images show, with the side from which they are seen: floors, tables, walls.

A patch is a square of pixels whose inverse depths lie on a plane: 1 / z = a x + b y + c for the rays (x, y, 1), which
holds exactly for a plane a X + b Y + c Z = 1. Patches of all images are averaged by cubic cells, so that a surface
counts by its area, not by how often it was seen.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...core.depth_noise import compute_sensor_sigma
from ...core.transforms import transform
from ...core.types import Intrinsics
from ...core.voxel_keys import KEY_LIMIT, pack_voxels

_COLUMNS = 320
"""Columns of pixels to take from an image, at most."""
_EDGE = 8
"""Pixels along the edge of a patch: 5 cm on a surface at 2 m."""
_NOISE, _ROUGH = 2.0, 0.002
"""A patch is flat up to this multiple of the sensor's noise, plus this share of its depth: steps of coarse units."""
CELL_M = 0.05
"""Edge of the cells."""
_ALIKE = 0.9
"""Smallest length of the mean normal of a cell's patches: less is an edge, or a board that is seen from both sides."""


@dataclass(frozen=True)
class SurfacePatches:
    """P cells of flat surface. points: (P, 3) float64 world, meters.  normals: (P, 3) float64 world, unit, to the side
    from which the surface is seen."""

    points: NDArray[np.float64]
    normals: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.points)

    def __getitem__(self, rows: NDArray[np.generic]) -> SurfacePatches:
        return SurfacePatches(self.points[rows], self.normals[rows])

    def moved(self, T: NDArray[np.float64]) -> SurfacePatches:
        """The patches in another frame, by a rigid (4, 4)."""
        return SurfacePatches(np.asarray(transform(T, self.points)), self.normals @ T[:3, :3].T)


def find_surface_patches(
    images: Iterable[tuple[NDArray[np.float32], Intrinsics, NDArray[np.float64]]],
) -> SurfacePatches:
    """Returns the patches of depth images: each (H, W) meters with 0 = no measurement, its camera, and (4, 4)
    ``T_world_cam``."""
    points, normals, weights = [np.zeros((0, 3))], [np.zeros((0, 3))], [np.zeros(0)]
    for depth_m, camera, T_world_cam in images:
        points_cam, normals_cam = find_patches(depth_m, camera)
        points.append(np.asarray(transform(T_world_cam, points_cam)))
        normals.append(normals_cam @ T_world_cam[:3, :3].T)
        weights.append(1 / compute_sensor_sigma(points_cam[:, 2]).astype(np.float64) ** 2)
    return _averaged(np.concatenate(points), np.concatenate(normals), np.concatenate(weights))


def find_patches(depth_m: NDArray[np.float32], camera: Intrinsics) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns (P, 3) centers, meters, and (P, 3) unit normals toward the camera, both in the camera's frame, of the
    flat patches of one depth image (H, W), meters."""
    step = max(1, round(camera.width / _COLUMNS))
    rows, columns = (length // (step * _EDGE) for length in depth_m.shape)
    taken = depth_m[: rows * step * _EDGE : step, : columns * step * _EDGE : step].astype(np.float64)
    blocks = taken.reshape(rows, _EDGE, columns, _EDGE).swapaxes(1, 2).reshape(-1, _EDGE, _EDGE)
    measured = (blocks > 0).all(axis=(1, 2))
    inverse = 1 / blocks[measured]
    offset = step * (np.arange(_EDGE) - (_EDGE - 1) / 2)
    du, dv = offset / camera.fx, offset / camera.fy
    middle = inverse.mean(axis=(1, 2))  # the three columns of the least-squares problem are orthogonal
    a = (inverse.mean(axis=1) * du).mean(axis=1) / (du**2).mean()
    b = (inverse.mean(axis=2) * dv).mean(axis=1) / (dv**2).mean()
    fitted = middle[:, None, None] + a[:, None, None] * du + b[:, None, None] * dv[:, None]
    row, column = np.divmod(np.flatnonzero(measured), max(columns, 1))
    x = (step * (_EDGE * column + (_EDGE - 1) / 2) - camera.cx) / camera.fx
    y = (step * (_EDGE * row + (_EDGE - 1) / 2) - camera.cy) / camera.fy
    depth = 1 / middle
    off = np.sqrt(((inverse - fitted) ** 2).mean(axis=(1, 2))) * depth**2
    flat = off < _NOISE * compute_sensor_sigma(depth) + _ROUGH * depth
    points = np.stack((x, y, np.ones(len(x))), axis=1) * depth[:, None]
    away = np.stack((a, b, middle - a * x - b * y), axis=1)
    return points[flat], -away[flat] / np.linalg.norm(away[flat], axis=1, keepdims=True)


def _averaged(
    points: NDArray[np.float64], normals: NDArray[np.float64], weights: NDArray[np.float64]
) -> SurfacePatches:
    """Returns one patch for each cell of ``CELL_M``."""
    voxels = np.clip(np.floor(points / CELL_M), -KEY_LIMIT, KEY_LIMIT - 1).astype(np.int64)
    keys, cell = np.unique(pack_voxels(voxels), return_inverse=True)
    total = np.bincount(cell, weights, minlength=len(keys))[:, None]
    means = [
        np.stack([np.bincount(cell, weights * values[:, i], len(keys)) for i in range(3)], axis=1) / total
        for values in (points, normals)
    ]
    length = np.linalg.norm(means[1], axis=1)
    alike = length > _ALIKE
    return SurfacePatches(means[0][alike], means[1][alike] / length[alike, None])
