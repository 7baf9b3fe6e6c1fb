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

from ...core.depth_sensors import DepthSensor
from ...core.transforms import transform
from ...core.types import Intrinsics
from ...core.voxel_keys import KEY_LIMIT, pack_voxels

_COLUMNS = 320
"""Columns of pixels to take from an image, at most."""
_EDGE = 8
"""Pixels along the edge of a patch: 5 cm on a surface at 2 m."""
_FEWEST = 16
"""Measured pixels of a patch, at least: sparse depth has holes."""
_LEAST_SPREAD = 0.05
"""Of the measured pixels' spread in both directions, 1 if these are independent: less is near a line."""
_NOISE, _ROUGH = 2.0, 0.002
"""A patch is flat up to this multiple of its depth's noise, plus this share of its depth: steps of coarse units."""
CELL_M = 0.05
"""Edge of the cells."""
_ALIKE = 0.9
"""Smallest length of the mean normal of a cell's patches: less is an edge, or a board that is seen from both sides."""

Fitted = tuple[NDArray[np.float64], ...]
"""What ``_fit_planes`` returns, (M,) each."""


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
    images: Iterable[tuple[NDArray[np.float32], NDArray[np.float32] | DepthSensor, Intrinsics]],
    T_world_cam: NDArray[np.float64],
) -> SurfacePatches:
    """Returns the patches of K depth images, each as ``find_patches`` takes it, from (K, 4, 4) poses."""
    points, normals, weights = [np.zeros((0, 3))], [np.zeros((0, 3))], [np.zeros(0)]
    for image, T in zip(images, T_world_cam, strict=True):
        points_cam, normals_cam, sigma_m = find_patches(*image)
        points.append(np.asarray(transform(T, points_cam)))
        normals.append(normals_cam @ T[:3, :3].T)
        weights.append(1 / sigma_m**2)
    return _averaged(np.concatenate(points), np.concatenate(normals), np.concatenate(weights))


def find_patches(
    depth_m: NDArray[np.float32], sigma: NDArray[np.float32] | DepthSensor, camera: Intrinsics
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Returns the flat patches of one depth image: (P, 3) centers, meters, and (P, 3) unit normals toward the camera,
    both in the camera's frame, and (P,) standard deviations of a pixel's depth, meters.

    depth_m: (H, W), 0 = no measurement.  sigma: its (H, W) standard deviations, meters, or those of its sensor.
    """
    step = max(1, round(camera.width / _COLUMNS))
    rows, columns = (length // (step * _EDGE) for length in depth_m.shape)

    def cut(values: NDArray[np.float32]) -> NDArray[np.float64]:
        taken = values[: rows * step * _EDGE : step, : columns * step * _EDGE : step].astype(np.float64)
        return taken.reshape(rows, _EDGE, columns, _EDGE).swapaxes(1, 2).reshape(-1, _EDGE**2)

    blocks = cut(depth_m)
    measured = (blocks > 0).sum(axis=1) >= _FEWEST
    offset = step * (np.arange(_EDGE) - (_EDGE - 1) / 2)
    du, dv = (each.ravel() for each in np.meshgrid(offset / camera.fx, offset / camera.fy))
    inverse, a, b, at_u, at_v, off = _fit_planes(blocks[measured], du, dv)
    row, column = np.divmod(np.flatnonzero(measured), max(columns, 1))
    x = (step * (_EDGE * column + (_EDGE - 1) / 2) - camera.cx) / camera.fx + at_u
    y = (step * (_EDGE * row + (_EDGE - 1) / 2) - camera.cy) / camera.fy + at_v
    depth = 1 / inverse
    if isinstance(sigma, DepthSensor):
        sigma_m = sigma.compute_sigma(depth).astype(np.float64)
    else:
        sigma_m = cut(sigma)[measured].sum(axis=1) / (blocks[measured] > 0).sum(axis=1)
    flat = off * depth**2 < _NOISE * sigma_m + _ROUGH * depth
    points = np.stack((x, y, np.ones(len(x))), axis=1) * depth[:, None]
    away = np.stack((a, b, inverse - a * x - b * y), axis=1)
    return points[flat], -away[flat] / np.linalg.norm(away[flat], axis=1, keepdims=True), sigma_m[flat]


def _fit_planes(depths: NDArray[np.float64], du: NDArray[np.float64], dv: NDArray[np.float64]) -> Fitted:
    """Returns, of M patches, the mean inverse depth; its slopes along u and v, by least squares; the mean place (u, v)
    of the measured pixels; and the root mean square of what the plane leaves, infinite where the slopes are open.

    depths: (M, N), 0 = no measurement.  du, dv: (N,) places of the pixels in a patch, of rays (u, v, 1).
    """
    shown = (depths > 0).astype(np.float64)
    count = shown.sum(axis=1)
    values = np.divide(1.0, depths, out=np.zeros_like(depths), where=depths > 0)
    mean, at_u, at_v = values.sum(axis=1) / count, shown @ du / count, shown @ dv / count
    u, v = shown * (du - at_u[:, None]), shown * (dv - at_v[:, None])
    uu, vv, uv = (u * u).sum(axis=1), (v * v).sum(axis=1), (u * v).sum(axis=1)
    uy, vy = (u * values).sum(axis=1), (v * values).sum(axis=1)
    area = uu * vv - uv**2
    known = area > _LEAST_SPREAD * uu * vv
    area = np.where(known, area, 1.0)
    a, b = (vv * uy - uv * vy) / area, (uu * vy - uv * uy) / area
    left = shown * (values - mean[:, None]) - a[:, None] * u - b[:, None] * v
    return mean, a, b, at_u, at_v, np.where(known, np.sqrt((left**2).sum(axis=1) / count), np.inf)


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
