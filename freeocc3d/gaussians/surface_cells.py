"""Sums points by cubic cells, which are kept in a hash table: memory grows with the surface."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.compiling import njit
from ..core.depth_noise import compute_sigma_image, look_up_sigma, take_sigma
from ..core.hash_table import build_table, cell_index, find_slot, packed_key
from ..core.transforms import back_project, transform
from ..core.types import PosedFrame
from ..core.voxel_keys import KEY_LIMIT, pack_voxels
from .depth_edges import is_at_edge, mask_away_from_edges

_SUMS = 7
"""Columns of a cell's sums: of weights, of weighted positions, of weighted colors."""


@dataclass(frozen=True)
class Cells:
    """N cells and the sums over their points, by ascending ``key``.

    points: (N, 3) float64 weighted means, world, meters.  colors: (N, 3) float64 weighted means.  weights: (N,) sums.
    pixels: (N,) number of measurements.  best: (N,) the largest weight of a measurement.  keyframe: (N,) int32 and
    footprint: (N,) float32, meters, those of that measurement.
    """

    key: NDArray[np.int64]
    points: NDArray[np.float64]
    colors: NDArray[np.float64]
    weights: NDArray[np.float64]
    pixels: NDArray[np.int64]
    best: NDArray[np.float64]
    keyframe: NDArray[np.int32]
    footprint: NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.key)

    def __getitem__(self, rows: NDArray[Any]) -> Cells:
        return Cells(*(getattr(self, name)[rows] for name in self.__dataclass_fields__))


class CellSums:
    """Sums measurements; ``cells`` returns their means. Memory: 88 bytes per cell, and 24 to 48 for the hash table.

    cell_size: edge of the cells, meters.  origin: (3,) a corner of cells, world, meters; the world's by default.
    """

    def __init__(self, cell_size: float, origin: NDArray[np.float64] | None = None):
        self.cell_size = cell_size
        self.origin = np.zeros(3) if origin is None else origin
        self._used = 0
        self._table, self._rows = build_table(np.zeros(0, np.int64), 0)
        self._key = np.zeros(0, np.int64)
        self._sums = np.zeros((0, _SUMS))
        self._pixels = np.zeros(0, np.int64)
        self._best = np.zeros(0)
        self._keyframe = np.zeros(0, np.int32)
        self._footprint = np.zeros(0, np.float32)

    def add_frame(self, posed: PosedFrame, step: int, edge: float) -> None:
        """Adds every ``step``-th pixel of every ``step``-th row, if it has a depth and is not at a depth edge."""
        frame, T, keyframe = posed
        camera = frame.intrinsics
        height, width = frame.depth_m.shape
        self._make_room(-(-height // step) * -(-width // step))
        T = T.copy()
        T[:3, 3] -= self.origin  # sums are relative to the origin
        self._used = _add_frame(
            frame.depth_m, take_sigma(frame), frame.color, step, edge, T,
            (camera.fx, camera.fy, camera.cx, camera.cy), keyframe, self.cell_size, self._used, *self._arrays(),
        )  # fmt: skip

    def add(self, cells: Cells) -> None:
        """Adds means to the cells that contain them, with all their measurements."""
        self._make_room(len(cells))
        points = cells.points - self.origin
        self._used = _add_cells(
            cell_keys(points, self.cell_size), points, cells.colors, cells.weights, cells.pixels,
            cells.best, cells.keyframe, cells.footprint, self._used, *self._arrays(),
        )  # fmt: skip

    def cells(self) -> Cells:
        """The means of all that was added."""
        rows = np.argsort(self._key[: self._used])
        sums = self._sums[rows]
        return Cells(
            self._key[rows],
            self.origin + sums[:, 1:4] / sums[:, :1],
            sums[:, 4:] / sums[:, :1],
            sums[:, 0],
            self._pixels[rows],
            self._best[rows],
            self._keyframe[rows],
            self._footprint[rows],
        )

    def _arrays(self) -> tuple[NDArray[Any], ...]:
        columns = self._key, self._sums, self._pixels, self._best, self._keyframe, self._footprint
        return (self._table, self._rows, *columns)

    def _make_room(self, more: int) -> None:
        """Makes room for ``more`` new cells."""
        wanted = self._used + more
        if wanted > len(self._key):
            room = max(wanted, 3 * len(self._key) // 2)
            for name in ("_key", "_sums", "_pixels", "_best", "_keyframe", "_footprint"):
                old = getattr(self, name)
                setattr(self, name, np.concatenate((old, np.zeros((room - len(old), *old.shape[1:]), old.dtype))))
        if 2 * wanted > len(self._table):
            self._table, self._rows = build_table(self._key[: self._used], wanted)


def cell_keys(points_world: NDArray[np.float64], cell_size: float) -> NDArray[np.int64]:
    """Converts (N, 3) meters to (N,) integers, one per cell; cells within 2**20 of the origin along each axis have
    distinct integers."""
    return pack_voxels(np.clip(np.floor(points_world / cell_size), -KEY_LIMIT, KEY_LIMIT - 1).astype(np.int64))


def cells_reference(posed: PosedFrame, step: int, edge: float, cell_size: float) -> Cells:
    """The cells that ``CellSums`` makes from one frame, in plain NumPy."""
    frame, T, row = posed
    v, u = (step * index for index in np.nonzero(mask_away_from_edges(frame.depth_m, edge)[::step, ::step]))
    depth = frame.depth_m[v, u]
    points = transform(T, back_project(np.stack((u, v), axis=1), depth, frame.intrinsics).astype(np.float64))
    key, cell = np.unique(cell_keys(points, cell_size), return_inverse=True)
    weight = 1.0 / compute_sigma_image(frame)[v, u].astype(np.float64) ** 2
    total = np.bincount(cell, weight)
    order = np.lexsort((-np.arange(len(cell)), weight, cell))
    best = order[np.flatnonzero(np.diff(cell[order], append=-1))]  # the first of the greatest weights in each cell
    return Cells(
        key,
        np.stack([np.bincount(cell, weight * points[:, i]) / total for i in range(3)], axis=1),
        np.stack([np.bincount(cell, weight * frame.color[v, u, i]) / total for i in range(3)], axis=1),
        np.asarray(total, np.float64),
        np.bincount(cell),
        weight[best],
        np.full(len(key), row, np.int32),
        (step * depth[best] / frame.intrinsics.fx).astype(np.float32),
    )


@njit(cache=True, nogil=True)
def _row_of(key, used, table, rows, keys):  # type: ignore[no-untyped-def]
    """Returns the row of a cell, a new one if it has none, and the number of rows."""
    at = find_slot(table, key)
    if table[at] == -1:
        table[at] = key
        rows[at] = used
        keys[used] = key
        used += 1
    return rows[at], used


@njit(cache=True, nogil=True)
def _add_frame(  # type: ignore[no-untyped-def]
    depth_m, sigma_m, color, step, edge, T, camera, keyframe, cell_size,
    used, table, rows, keys, sums, pixels, best, best_keyframe, footprint,
):  # fmt: skip
    fx, fy, cx, cy = camera
    row, before = 0, np.int64(-1)
    for v in range(0, depth_m.shape[0], step):
        for u in range(0, depth_m.shape[1], step):
            depth = np.float64(depth_m[v, u])
            if depth <= 0 or is_at_edge(depth_m, v, u, edge):
                continue
            x, y = (u - cx) / fx * depth, (v - cy) / fy * depth
            wx = T[0, 0] * x + T[0, 1] * y + T[0, 2] * depth + T[0, 3]
            wy = T[1, 0] * x + T[1, 1] * y + T[1, 2] * depth + T[1, 3]
            wz = T[2, 0] * x + T[2, 1] * y + T[2, 2] * depth + T[2, 3]
            i, j, k = cell_index(wx / cell_size), cell_index(wy / cell_size), cell_index(wz / cell_size)
            key = packed_key(i, j, k)
            if key != before:  # neighbors are mostly in one cell
                row, used = _row_of(key, used, table, rows, keys)
                before = key
            sigma = look_up_sigma(sigma_m, v, u, depth)
            w = 1.0 / (sigma * sigma)
            sums[row, 0] += w
            sums[row, 1] += w * wx
            sums[row, 2] += w * wy
            sums[row, 3] += w * wz
            for channel in range(3):
                sums[row, 4 + channel] += w * color[v, u, channel]
            pixels[row] += 1
            if w > best[row]:
                best[row], best_keyframe[row], footprint[row] = w, keyframe, step * depth / fx
    return used


@njit(cache=True, nogil=True)
def _add_cells(  # type: ignore[no-untyped-def]
    key, points, colors, weights, count, greatest, keyframe, spacing,
    used, table, rows, keys, sums, pixels, best, best_keyframe, footprint,
):  # fmt: skip
    for n in range(len(key)):
        row, used = _row_of(key[n], used, table, rows, keys)
        sums[row, 0] += weights[n]
        for i in range(3):
            sums[row, 1 + i] += weights[n] * points[n, i]
            sums[row, 4 + i] += weights[n] * colors[n, i]
        pixels[row] += count[n]
        if greatest[n] > best[row]:
            best[row], best_keyframe[row], footprint[row] = greatest[n], keyframe[n], spacing[n]
    return used
