"""Points of a scan that several views confirm, and the rays from cameras to these points."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .cross_view_check import DepthImage, confirm_depth
from .photo_consistency import compute_rays

_SAME_DEPTH = 0.01  # relative difference within which views always agree
_LOOKING_THROUGH = 0.5  # largest ratio of contradicting to agreeing views
_CELL = 0.01  # edge of a cell, as a share of the scan's depth
_LEAST_VIEWS = 2
_BITS = 20  # of a cell index along one axis
_HALF = 1 << _BITS - 1  # the middle cell index
_MOST = 500_000  # points: the graph cut of their tetrahedra takes about 2 GB
_UNCONFIRMED = 4  # times as many cells are kept before unconfirmed ones are dropped


@dataclass(frozen=True)
class ScanPoints:
    """The points of a scan. points: (P, 3) float64 world, meters.  sigma_m: (P,) meters.  ray_point, ray_camera: (R,)
    int32, point and camera of each measuring ray.  cell_m: edge of the cells, meters; each cell holds one point."""

    points: NDArray[np.float64]
    sigma_m: NDArray[np.float64]
    ray_point: NDArray[np.int32]
    ray_camera: NDArray[np.int32]
    cell_m: float


def confirm_points(
    view: DepthImage, others: Sequence[DepthImage], agreeing: int, device: str = "cpu"
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(N, 3) world points of a view, and their (N,) standard deviations, meters. At least ``agreeing`` of the
    ``others`` see each point at the same depth, and few see through it."""
    found = confirm_depth(view, others, _SAME_DEPTH, device)
    keep = (found.agreeing >= agreeing) & (found.through <= _LOOKING_THROUGH * found.agreeing)
    there = keep.cpu().numpy() & (view.inverse > 0)
    z = 1.0 / found.inverse.cpu().numpy()[there].astype(np.float64)
    T = view.T_world_cam
    points = (compute_rays(view.camera).numpy()[:, there].T * z[:, None]) @ T[:3, :3].T + T[:3, 3]
    return points, found.sigma.cpu().numpy()[there] * z**2


def merge_points(
    measured: Iterable[tuple[NDArray[np.float64], NDArray[np.float64]]], depth_m: float, most: int = _MOST
) -> ScanPoints:
    """Merge points to one per cell: their mean, weighted by inverse variance. The edge of a cell is a hundredth of the
    scan's typical ``depth_m``, and doubles until at most ``most`` points remain. Points from only one camera are left
    out.

    measured: (N, 3) points and (N,) sigma, meters, of each camera.
    """
    cells = _Cells.none(_CELL * depth_m)
    waiting: list[_Cells] = []
    for camera, (points, sigma_m) in enumerate(measured):
        waiting.append(_Cells.of(camera, points, sigma_m, cells.edge))
        if sum(len(part.keys) for part in waiting) > len(cells.keys):
            cells, waiting = _joined([cells, *waiting]), []
        while len(cells.keys) > _UNCONFIRMED * most:
            cells, waiting = _joined([cells, *waiting]).coarser(), []
    cells = _joined([cells, *waiting])
    while True:
        row = np.searchsorted(cells.keys, cells.ray_key)
        keep = np.bincount(row, minlength=len(cells.keys)) >= _LEAST_VIEWS
        if np.count_nonzero(keep) <= most:
            break
        cells = cells.coarser()
    weight, places, spread = np.split(cells.sums[keep], (1, 4), axis=1)
    seen = keep[row]
    ray_point = (np.cumsum(keep) - 1)[row[seen]].astype(np.int32)
    return ScanPoints(places / weight, (spread / weight)[:, 0], ray_point, cells.ray_camera[seen], cells.edge)


@dataclass(frozen=True)
class _Cells:
    """Sums over the points in each cell. keys: (K,) int64, ascending, packed cell indices.  sums: (K, 5) sums of
    weights and of weighted x, y, z, sigma.
    ray_key, ray_camera: (R,) unique pairs of a cell and a camera that measured a point in it."""

    edge: float
    keys: NDArray[np.int64]
    sums: NDArray[np.float64]
    ray_key: NDArray[np.int64]
    ray_camera: NDArray[np.int32]

    @classmethod
    def none(cls, edge: float) -> _Cells:
        return cls.of(0, np.zeros((0, 3)), np.zeros(0), edge)

    @classmethod
    def of(cls, camera: int, points: NDArray[np.float64], sigma_m: NDArray[np.float64], edge: float) -> _Cells:
        numbers = np.floor(points / edge) + _HALF
        near = ((numbers >= 0) & (numbers < 2 * _HALF)).all(axis=1)
        x, y, z = numbers[near].astype(np.int64).T
        weight = 1.0 / sigma_m[near] ** 2
        columns = (weight, *(weight * points[near].T), weight * sigma_m[near])
        keys, sums = _summed((x << 2 * _BITS) | (y << _BITS) | z, np.stack(columns, axis=1))
        return cls(edge, keys, sums, keys, np.full(len(keys), camera, np.int32))

    def coarser(self) -> _Cells:
        """The same content in cells with twice the edge."""
        keys, sums = _summed(_halved(self.keys), self.sums)
        ray_key, ray_camera = _halved(self.ray_key), self.ray_camera
        order = np.lexsort((ray_camera, ray_key))
        ray_key, ray_camera = ray_key[order], ray_camera[order]
        new = np.ones(len(order), bool)
        new[1:] = (np.diff(ray_key) != 0) | (np.diff(ray_camera) != 0)
        return _Cells(2.0 * self.edge, keys, sums, ray_key[new], ray_camera[new])


def _joined(parts: Sequence[_Cells]) -> _Cells:
    """Join cells of equal edge; no two parts share a camera."""
    keys, sums = _summed(np.concatenate([p.keys for p in parts]), np.concatenate([p.sums for p in parts]))
    return _Cells(
        parts[0].edge,
        keys,
        sums,
        np.concatenate([part.ray_key for part in parts]),
        np.concatenate([part.ray_camera for part in parts]),
    )


def _summed(keys: NDArray[np.int64], sums: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    unique, which = np.unique(keys, return_inverse=True)
    return unique, np.stack([np.bincount(which, column, len(unique)) for column in sums.T], axis=1)


def _halved(keys: NDArray[np.int64]) -> NDArray[np.int64]:
    """Packed indices of the cells with twice the edge, relative to the same middle."""
    one = (1 << _BITS) - 1
    x, y, z = (((keys >> shift & one) + _HALF) >> 1 for shift in (2 * _BITS, _BITS, 0))
    return np.asarray((x << 2 * _BITS) | (y << _BITS) | z)
