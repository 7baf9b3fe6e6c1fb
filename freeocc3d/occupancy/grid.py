"""Sparse blocks of 8 x 8 x 8 voxels: which exist, and where a block is found."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ..types import BLOCK

KEY_LIMIT = 1 << 20
"""Block indices lie in [-KEY_LIMIT, KEY_LIMIT) along each axis. Single precision of positions ends far earlier: a
kilometre from the origin it costs tenths of a millimetre."""


def pack(keys: NDArray[np.integer]) -> NDArray[np.int64]:
    """(B, 3) block indices to (B,) one integer each, in the order of (i, j, k)."""
    k = np.asarray(keys, np.int64) + KEY_LIMIT
    return (k[:, 0] << 42) | (k[:, 1] << 21) | k[:, 2]


def unpack(packed: NDArray[np.int64]) -> NDArray[np.int32]:
    """The inverse of ``pack``."""
    mask = (1 << 21) - 1
    keys = np.stack((packed >> 42, (packed >> 21) & mask, packed & mask), axis=1) - KEY_LIMIT
    return keys.astype(np.int32)


def union(*packed: NDArray[np.int64]) -> NDArray[np.int64]:
    """Ascending unique packed keys of all arguments."""
    return np.unique(np.concatenate(packed)) if packed else np.zeros(0, np.int64)


def blocks_along_rays(
    points_world: NDArray[np.floating],
    center_world: NDArray[np.floating],
    origin: NDArray[np.float64],
    voxel_size: float,
) -> NDArray[np.int64]:
    """Packed keys of the blocks that lie on the segments from a camera's centre to (P, 3) points, sampled at half a
    block; a corner that a segment only grazes may be missed."""
    edge = BLOCK * voxel_size
    steps = np.linalg.norm(points_world - center_world, axis=1) / (0.5 * edge)
    fractions = np.linspace(0.0, 1.0, int(np.ceil(steps.max(initial=0.0))) + 1)
    samples = center_world + (points_world - center_world)[:, None] * fractions[None, :, None]
    keys = np.floor((samples.reshape(-1, 3) - origin) / edge).astype(np.int64)
    return np.unique(pack(keys))


@njit(cache=True)
def packed_key(i: int, j: int, k: int) -> int:
    """``pack`` for one block index."""
    return ((i + KEY_LIMIT) << 42) | ((j + KEY_LIMIT) << 21) | (k + KEY_LIMIT)


@njit(cache=True)
def _slot(table: NDArray[np.int64], key: int) -> int:
    """Where ``key`` stands, or would be put, in an open-addressing table whose size is a power of two (-1 = empty)."""
    mask = len(table) - 1
    at = (((key * -7046029254386353131) & 0x7FFFFFFFFFFFFFFF) >> 20) & mask  # Fibonacci hashing
    while table[at] != -1 and table[at] != key:
        at = (at + 1) & mask
    return at


@njit(cache=True, nogil=True)
def touched_blocks(lo: NDArray[np.int32], hi: NDArray[np.int32]) -> NDArray[np.int64]:
    """Distinct packed keys of the blocks that boxes of voxels, (N, 3) first and last index, touch; empty boxes
    (lo > hi) touch none."""
    table = np.full(1024, -1, np.int64)
    count = 0
    last = np.int64(-1)  # neighbours in memory are mostly neighbours in space
    for g in range(len(lo)):
        if lo[g, 0] > hi[g, 0] or lo[g, 1] > hi[g, 1] or lo[g, 2] > hi[g, 2]:
            continue
        for i in range(lo[g, 0] >> 3, (hi[g, 0] >> 3) + 1):
            for j in range(lo[g, 1] >> 3, (hi[g, 1] >> 3) + 1):
                for k in range(lo[g, 2] >> 3, (hi[g, 2] >> 3) + 1):
                    key = packed_key(i, j, k)
                    if key == last:
                        continue
                    last = key
                    at = _slot(table, key)
                    if table[at] == key:
                        continue
                    table[at] = key
                    count += 1
                    if 2 * count > len(table):
                        grown = np.full(2 * len(table), -1, np.int64)
                        for old in table:
                            if old != -1:
                                grown[_slot(grown, old)] = old
                        table = grown
    return table[table != -1]


@njit(cache=True)
def build_table(packed: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
    """A hash table from packed key to row: (table of keys, rows beside them)."""
    size = 1024
    while size < 2 * len(packed) + 1:
        size *= 2
    table = np.full(size, -1, np.int64)
    rows = np.full(size, -1, np.int32)
    for row in range(len(packed)):
        at = _slot(table, packed[row])
        table[at] = packed[row]
        rows[at] = row
    return table, rows


@njit(cache=True)
def find(table: NDArray[np.int64], rows: NDArray[np.int32], key: int) -> int:
    """Row of ``key``, -1 if it is not there."""
    at = _slot(table, key)
    return rows[at] if table[at] == key else -1
