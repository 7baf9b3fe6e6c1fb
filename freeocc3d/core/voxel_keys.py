"""Voxels as integers: one key per voxel, a set of voxels as a sorted array. Uses NumPy only, so it imports fast."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

AXIS_BITS = 21
"""Bits of a key for each axis."""

KEY_LIMIT = 1 << AXIS_BITS - 1
"""Indices lie in [-KEY_LIMIT, KEY_LIMIT) along each axis. Single-precision positions lose accuracy far earlier: tenths
of a millimeter at a kilometer from the origin."""


def pack_index(i: Any, j: Any, k: Any) -> Any:
    """One integer from three indices, ordered as (i, j, k). Takes numbers, int64 arrays or tensors; also compilable."""
    return ((i + KEY_LIMIT) << 2 * AXIS_BITS) | ((j + KEY_LIMIT) << AXIS_BITS) | (k + KEY_LIMIT)


def pack_voxels(index: NDArray[np.integer]) -> NDArray[np.int64]:
    """(V, 3) indices, |i| < 2^20, to (V,) keys, which sort as (i, j, k)."""
    return np.asarray(pack_index(*index.astype(np.int64).T))


def unpack_voxels(packed: NDArray[np.int64]) -> NDArray[np.int32]:
    """The inverse of ``pack_voxels``."""
    mask = (1 << AXIS_BITS) - 1
    index = np.stack((packed >> 2 * AXIS_BITS, (packed >> AXIS_BITS) & mask, packed & mask), axis=1)
    return np.asarray(index - KEY_LIMIT, np.int32)


def contains(ascending: NDArray[np.int64], keys: NDArray[np.int64]) -> NDArray[np.bool_]:
    """(K,) whether each key is in the ascending array."""
    if not len(ascending):
        return np.zeros(len(keys), bool)
    return np.asarray(ascending[np.minimum(np.searchsorted(ascending, keys), len(ascending) - 1)] == keys)
