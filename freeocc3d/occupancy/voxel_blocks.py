"""Sparse blocks of 8 x 8 x 8 voxels: finds the blocks that rays and boxes touch."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..core.compiling import njit
from ..core.errors import ConfigError
from ..core.hash_table import cell_index, packed_key, put_key
from ..core.memory import available_memory
from ..core.types import BLOCK

_VOXEL_BYTES = 24
"""Of a voxel while a map is built: counts, alpha, state, and the copies of them that are made on the way."""


def unite_keys(*packed: NDArray[np.int64]) -> NDArray[np.int64]:
    """Returns the ascending unique packed keys of all arguments."""
    return np.unique(np.concatenate(packed)) if packed else np.zeros(0, np.int64)


def find_blocks_along_rays(
    points_world: NDArray[np.floating],
    center_world: NDArray[np.floating],
    origin: NDArray[np.float64],
    voxel_size: float,
) -> NDArray[np.int64]:
    """Returns the ascending packed keys of all blocks on the segments from a camera's center to (P, 3) points. Raises
    ConfigError, without an end of the walk, if these are more than fit into the memory that is free."""
    edge = BLOCK * voxel_size
    ends = (np.asarray(points_world, np.float64) - origin) / edge
    start = (np.asarray(center_world, np.float64) - origin) / edge
    most = available_memory() // (BLOCK**3 * _VOXEL_BYTES)
    keys = _walked(start, ends, most)
    if len(keys) > most:
        refuse_blocks(len(keys), voxel_size)
    return np.sort(keys)


def refuse_blocks(blocks: float, voxel_size: float) -> None:
    """Raises ConfigError if that many blocks of voxels do not fit into the memory that is free."""
    needed, free = blocks * BLOCK**3 * _VOXEL_BYTES, available_memory()
    if needed > free:
        raise ConfigError(
            f"{blocks * BLOCK**3:.3g} voxels of {voxel_size:g} m need about {needed / 1e9:.1f} GB of memory, but "
            f"{free / 1e9:.1f} GB are free: choose a larger occupancy.voxel_size, or a smaller capture.max_depth."
        )


@njit(cache=True, nogil=True)
def find_touched_blocks(lo: NDArray[np.int32], hi: NDArray[np.int32]) -> NDArray[np.int64]:
    """Returns the distinct packed keys of the blocks that boxes of voxels touch. lo, hi: (N, 3) first and last index;
    an empty box (lo > hi) touches no block."""
    table = np.full(1024, -1, np.int64)
    count = 0
    last = np.int64(-1)  # Gaussians that are close in memory are mostly close in space
    for g in range(len(lo)):
        if lo[g, 0] > hi[g, 0] or lo[g, 1] > hi[g, 1] or lo[g, 2] > hi[g, 2]:
            continue
        for i in range(lo[g, 0] >> 3, (hi[g, 0] >> 3) + 1):
            for j in range(lo[g, 1] >> 3, (hi[g, 1] >> 3) + 1):
                for k in range(lo[g, 2] >> 3, (hi[g, 2] >> 3) + 1):
                    key = packed_key(i, j, k)
                    if key != last:
                        last = key
                        table, count = put_key(table, count, key)
    return table[table != -1]


@njit(cache=True, nogil=True)
def _walked(start: NDArray[np.float64], ends: NDArray[np.float64], most: int) -> NDArray[np.int64]:
    """Returns the distinct packed keys of the unit cells on the segments from one point to (P, 3) others. Ends after
    the first key beyond ``most``.

    Source: J. Amanatides, A. Woo, A Fast Voxel Traversal Algorithm for Ray Tracing, Eurographics 1987.
    """
    table = np.full(1024, -1, np.int64)
    count = 0
    cell, step = np.empty(3, np.int64), np.empty(3, np.int64)
    next_face, between = np.empty(3), np.empty(3)  # as shares of the segment
    for p in range(len(ends)):
        faces = 0
        for i in range(3):
            cell[i] = cell_index(start[i])
            length = ends[p, i] - start[i]
            step[i] = 1 if length > 0 else -1
            faces += abs(cell_index(ends[p, i]) - cell[i])
            between[i] = 1.0 / abs(length) if length != 0 else np.inf
            ahead = cell[i] + 1 - start[i] if length > 0 else start[i] - cell[i]
            next_face[i] = ahead * between[i] if length != 0 else np.inf
        table, count = put_key(table, count, packed_key(cell[0], cell[1], cell[2]))
        for _ in range(faces):
            i = 0
            if next_face[1] < next_face[i]:
                i = 1
            if next_face[2] < next_face[i]:
                i = 2
            cell[i] += step[i]
            next_face[i] += between[i]
            table, count = put_key(table, count, packed_key(cell[0], cell[1], cell[2]))
            if count > most:
                return table[table != -1]
    return table[table != -1]
