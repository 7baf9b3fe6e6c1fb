"""Voxels as integers: one key a voxel, sets of them as sorted arrays. NumPy only, to import fast."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

AXIS_BITS = 21
"""Of a key, for each axis."""

KEY_LIMIT = 1 << AXIS_BITS - 1
"""Indices lie in [-KEY_LIMIT, KEY_LIMIT) along each axis. Single precision of positions ends far earlier: a kilometer
from the origin it costs tenths of a millimeter."""


def pack_index(i: Any, j: Any, k: Any) -> Any:
    """One integer for three indices, in their order: for numbers, int64 arrays and tensors, and compiled code alike."""
    return ((i + KEY_LIMIT) << 2 * AXIS_BITS) | ((j + KEY_LIMIT) << AXIS_BITS) | (k + KEY_LIMIT)


def pack_voxels(index: NDArray[np.integer]) -> NDArray[np.int64]:
    """(V, 3) indices, |i| < 2^20, to (V,) one integer each, in the order of (i, j, k)."""
    return np.asarray(pack_index(*index.astype(np.int64).T))


def unpack_voxels(packed: NDArray[np.int64]) -> NDArray[np.int32]:
    """The inverse of ``pack_voxels``."""
    mask = (1 << AXIS_BITS) - 1
    index = np.stack((packed >> 2 * AXIS_BITS, (packed >> AXIS_BITS) & mask, packed & mask), axis=1)
    return np.asarray(index - KEY_LIMIT, np.int32)


def contains(ascending: NDArray[np.int64], keys: NDArray[np.int64]) -> NDArray[np.bool_]:
    """(K,) whether each key is among the ascending ones."""
    if not len(ascending):
        return np.zeros(len(keys), bool)
    return np.asarray(ascending[np.minimum(np.searchsorted(ascending, keys), len(ascending) - 1)] == keys)
