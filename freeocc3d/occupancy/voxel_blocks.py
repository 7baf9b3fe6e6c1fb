"""Sparse blocks of 8 x 8 x 8 voxels: finds the blocks that rays and boxes touch."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ..core.compiling import njit
from ..core.hash_table import packed_key, put_key
from ..core.types import BLOCK


def unite_keys(*packed: NDArray[np.int64]) -> NDArray[np.int64]:
    """Returns the ascending unique packed keys of all arguments."""
    return np.unique(np.concatenate(packed)) if packed else np.zeros(0, np.int64)


def find_blocks_along_rays(
    points_world: NDArray[np.floating],
    center_world: NDArray[np.floating],
    origin: NDArray[np.float64],
    voxel_size: float,
) -> NDArray[np.int64]:
    """Returns the ascending packed keys of all blocks on the segments from a camera's center to (P, 3) points."""
    edge = BLOCK * voxel_size
    ends = (np.asarray(points_world, np.float64) - origin) / edge
    return np.sort(_walked((np.asarray(center_world, np.float64) - origin) / edge, ends))


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
def _walked(start: NDArray[np.float64], ends: NDArray[np.float64]) -> NDArray[np.int64]:
    """Returns the distinct packed keys of the unit cells on the segments from one point to (P, 3) others.

    Source: J. Amanatides, A. Woo, A Fast Voxel Traversal Algorithm for Ray Tracing, Eurographics 1987.
    """
    table = np.full(1024, -1, np.int64)
    count = 0
    cell, step = np.empty(3, np.int64), np.empty(3, np.int64)
    next_face, between = np.empty(3), np.empty(3)  # as shares of the segment
    for p in range(len(ends)):
        faces = 0
        for i in range(3):
            cell[i] = math.floor(start[i])
            length = ends[p, i] - start[i]
            step[i] = 1 if length > 0 else -1
            faces += abs(np.int64(math.floor(ends[p, i])) - cell[i])
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
    return table[table != -1]
