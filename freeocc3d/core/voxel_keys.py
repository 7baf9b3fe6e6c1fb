"""Voxels as integers: one key a voxel, sets of them as sorted arrays. NumPy only, to import fast."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

AXIS_BITS = 21
"""Of a key, for each axis: indices lie in [-2^20, 2^20)."""


def packed_voxels(index: NDArray[np.integer]) -> NDArray[np.int64]:
    """(V, 3) indices, |i| < 2^20, to (V,) one integer each, in the order of (i, j, k)."""
    i = index.astype(np.int64) + (1 << AXIS_BITS - 1)
    return (i[:, 0] << 2 * AXIS_BITS) + (i[:, 1] << AXIS_BITS) + i[:, 2]


def unpacked_voxels(packed: NDArray[np.int64]) -> NDArray[np.int32]:
    """The inverse of ``packed_voxels``."""
    mask = (1 << AXIS_BITS) - 1
    index = np.stack((packed >> 2 * AXIS_BITS, (packed >> AXIS_BITS) & mask, packed & mask), axis=1)
    return np.asarray(index - (1 << AXIS_BITS - 1), np.int32)


def contains(ascending: NDArray[np.int64], keys: NDArray[np.int64]) -> NDArray[np.bool_]:
    """(K,) whether each key is among the ascending ones."""
    if not len(ascending):
        return np.zeros(len(keys), bool)
    return np.asarray(ascending[np.minimum(np.searchsorted(ascending, keys), len(ascending) - 1)] == keys)
