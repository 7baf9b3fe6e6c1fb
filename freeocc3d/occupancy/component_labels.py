"""Connected components of very many voxels, compiled: finds neighbors in blocks of 8 x 8 x 8 voxels."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..core.compiling import njit
from ..core.hash_table import build_table, find_row, packed_key
from ..core.types import BLOCK
from ..core.union_find import find_root, join_sets
from ..core.voxel_keys import pack_voxels, unpack_voxels

_VOXELS = BLOCK**3
SPARSEST = 16
"""Least mean number of voxels per block. Fewer would waste memory: a block takes 2 KB."""


def label_lattice(voxels: NDArray[np.int32]) -> NDArray[np.int32] | None:
    """Returns the (V,) component number of each of (V, 3) distinct voxels. Numbers follow the first voxels of the
    components. Voxels that share a face, edge or corner are connected. None if the voxels are too sparse for blocks."""
    packed = pack_voxels(voxels >> 3)
    starts = np.flatnonzero(np.diff(packed, prepend=packed[:1] - 1))  # a map stores its voxels block by block
    blocks = np.unique(packed[starts])
    if len(voxels) < SPARSEST * len(blocks):
        return None
    table, rows = build_table(blocks, len(blocks))
    return np.asarray(_connected(voxels, packed, unpack_voxels(blocks), table, rows))


@njit(cache=True)
def _connected(
    voxels: NDArray[np.int32],
    packed: NDArray[np.int64],
    keys: NDArray[np.int32],
    table: NDArray[np.int64],
    rows: NDArray[np.int32],
) -> NDArray[np.int32]:
    at = np.full((len(keys), _VOXELS), np.int32(-1), np.int32)  # row of each voxel that exists
    block, last = 0, np.int64(-1)
    for n in range(len(voxels)):
        if packed[n] != last:
            block, last = find_row(table, rows, packed[n]), packed[n]
        at[block, ((voxels[n, 0] & 7) * BLOCK + (voxels[n, 1] & 7)) * BLOCK + (voxels[n, 2] & 7)] = n
    parent = np.arange(len(voxels)).astype(np.int32)
    near = np.empty(27, np.int32)  # rows of the block's neighbors, with the block itself in the middle
    for b in range(len(keys)):
        for side in range(27):
            i, j, k = side // 9 - 1, side // 3 % 3 - 1, side % 3 - 1
            near[side] = find_row(table, rows, packed_key(keys[b, 0] + i, keys[b, 1] + j, keys[b, 2] + k))
        for i in range(BLOCK):
            for j in range(BLOCK):
                for k in range(BLOCK):
                    here = at[b, (i * BLOCK + j) * BLOCK + k]
                    if here < 0:
                        continue
                    for step in range(14, 27):  # half of the neighbors: the other half looks back at this voxel
                        x, y, z = i + step // 9 - 1, j + step // 3 % 3 - 1, k + step % 3 - 1
                        side = near[((x >> 3) + 1) * 9 + ((y >> 3) + 1) * 3 + (z >> 3) + 1]
                        if side < 0:
                            continue
                        there = at[side, ((x & 7) * BLOCK + (y & 7)) * BLOCK + (z & 7)]
                        if there >= 0:
                            join_sets(parent, here, there)
    number = np.empty(len(voxels), np.int32)
    count = 0
    for n in range(len(voxels)):  # a root is the first voxel of its component
        root = find_root(parent, n)
        if root == n:
            number[n] = count
            count += 1
        else:
            number[n] = number[root]
    return number
