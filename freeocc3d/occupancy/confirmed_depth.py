"""Depth that ends at a surface of the map. Only this carves free space.

A speck behind a pane, depth between the two sides of an edge or a reflection is no surface, so it has no Gaussian. Its
ray goes through the pane, or past the edge, to where nothing is. What lies on this way is as unknown as its end.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np
from numba import prange
from numpy.typing import NDArray

from ..core.compiling import njit
from ..core.depth_noise import look_up_sigma, take_sigma
from ..core.hash_table import build_table, cell_index, find_slot, packed_key
from ..core.types import Gaussians, PosedFrame
from ..core.voxel_keys import KEY_LIMIT, pack_voxels

_SIGMAS = 3.0
"""Standard deviations of a depth within which its surface lies: 99.7 % of Gaussian noise."""

HIDDEN_M = 1e-3
"""Depth of a pixel that is not confirmed: it hides all that is behind it, as far as its own frame can tell."""


def hide_unconfirmed(
    frames: Iterable[PosedFrame], gaussians: Gaussians, voxel_size: float, cell_size: float | None = None
) -> Iterator[PosedFrame]:
    """Yields the frames with ``HIDDEN_M`` as the depth of pixels that end where no surface is.

    gaussians: of the whole map.  voxel_size, cell_size: of the map and its Gaussians, meters; the larger of half a
    voxel and a cell is the edge of a cube. A pixel ends at a surface if a Gaussian lies in the same cube or in one of
    the 26 around it, or in those of a place up to three standard deviations along the ray.
    """
    edge = max(0.5 * voxel_size, cell_size or 0.0)
    cells = _mark_cells(gaussians.means, edge)
    table = build_table(cells, len(cells))[0]
    for posed in frames:
        frame, camera = posed.frame, posed.frame.intrinsics
        depth_m = _confirm(
            frame.depth_m, take_sigma(frame), posed.T_world_cam / edge,
            (camera.fx, camera.fy, camera.cx, camera.cy), np.float32(edge), table,
        )  # fmt: skip
        yield posed._replace(frame=replace(frame, depth_m=depth_m))


def _mark_cells(points: NDArray[np.floating], edge: float) -> NDArray[np.int64]:
    """Returns the keys of the cells of some points (N, 3) and of the 26 cells around each."""
    inside = np.clip(np.floor(points.astype(np.float64) / edge), 1 - KEY_LIMIT, KEY_LIMIT - 2).astype(np.int64)
    cells = np.unique(pack_voxels(inside))
    for step in pack_voxels(np.eye(3, dtype=np.int64)) - pack_voxels(np.zeros((1, 3), np.int64)):
        cells = np.unique(np.concatenate((cells - step, cells, cells + step)))
    return cells


@njit(parallel=True, cache=True)
def _confirm(
    depth_m: NDArray[np.float32],
    sigma_m: NDArray[np.float32],
    T: NDArray[np.float64],  # from meters in the camera's frame to cells
    camera: tuple[float, float, float, float],
    edge: np.float32,
    table: NDArray[np.int64],
) -> NDArray[np.float32]:
    fx, fy, cx, cy = camera
    height, width = depth_m.shape
    confirmed = np.zeros((height, width), np.float32)
    per_pixel = np.float32(1.0 / fx)
    for row in prange(height):
        last, at = np.float32(0.0), 0  # depth and column of the last pixel that was found at a surface
        for column in range(width):
            depth = depth_m[row, column]
            if depth <= 0:
                continue
            if abs(depth - last) + np.float32(column - at) * per_pixel * depth > edge:
                x, y, sigma = (column - cx) / fx, (row - cy) / fy, look_up_sigma(sigma_m, row, column, depth)
                if not _ends_at_surface(T, x, y, np.float64(depth), sigma, edge, table):
                    confirmed[row, column] = HIDDEN_M
                    continue
                last, at = depth, column
            confirmed[row, column] = depth
    return confirmed


@njit(cache=True)
def _ends_at_surface(
    T: NDArray[np.float64], x: float, y: float, depth: float, sigma: float, edge: float, table: NDArray[np.int64]
) -> bool:
    """Whether the ray (x, y, 1) is in a marked cell at a depth, or at one within some standard deviations of it."""
    ray_x = T[0, 0] * x + T[0, 1] * y + T[0, 2]
    ray_y = T[1, 0] * x + T[1, 1] * y + T[1, 2]
    ray_z = T[2, 0] * x + T[2, 1] * y + T[2, 2]
    steps = math.ceil(_SIGMAS * sigma / edge)
    for n in range(2 * steps + 1):
        step = (n + 1) // 2 * (1 - 2 * (n % 2)) / max(steps, 1)  # 0, then to both sides in turn
        z = depth + _SIGMAS * sigma * step
        i, j, k = cell_index(ray_x * z + T[0, 3]), cell_index(ray_y * z + T[1, 3]), cell_index(ray_z * z + T[2, 3])
        key = packed_key(i, j, k)
        if table[find_slot(table, key)] == key:
            return True
    return False
