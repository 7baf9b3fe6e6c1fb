"""The surface of the occupied voxels, for meshes and pictures."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..types import Occupancy


def exposed_faces(
    occupancy: Occupancy, chosen: NDArray[np.bool_] | None = None
) -> tuple[NDArray[np.float32], NDArray[np.int32], NDArray[np.int64]]:
    """The faces between occupied voxels and all others: (4 F, 3) vertices in metres, (F, 4) quads that index them,
    counter-clockwise seen from outside, and (F,) the occupied voxel's row that each face belongs to.

    chosen: (V,) the occupied voxels to draw, as if there were no others; all by default.
    """
    voxels = occupancy.occupied_voxels()
    chosen_rows = np.arange(len(voxels)) if chosen is None else np.flatnonzero(chosen)
    corners, quads, rows = faces_of(voxels[chosen_rows])
    vertices = (occupancy.origin + corners * occupancy.voxel_size).astype(np.float32)
    return vertices, quads, chosen_rows[rows]


def faces_of(voxels: NDArray[np.integer]) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.int64]]:
    """The faces of (V, 3) voxel indices, |i| < 2^20: as ``exposed_faces``, but (4 F, 3) corners on the lattice."""
    index = voxels.astype(np.int64) + (1 << 20)
    keys = (index[:, 0] << 42) + (index[:, 1] << 21) + index[:, 2]
    ascending = np.sort(keys)
    corners, rows = [], []
    for axis in range(3):
        for side in (0, 1):
            neighbour = keys + ((2 * side - 1) << 21 * (2 - axis))
            at = np.minimum(np.searchsorted(ascending, neighbour), len(ascending) - 1)
            exposed = np.flatnonzero(ascending[at] != neighbour)
            b, c = (axis + 1) % 3, (axis + 2) % 3
            turn = [(0, 0), (1, 0), (1, 1), (0, 1)] if side else [(0, 0), (0, 1), (1, 1), (1, 0)]
            offset = np.zeros((4, 3), np.int32)
            offset[:, axis], offset[:, [b, c]] = side, turn
            corners.append(voxels[exposed, None].astype(np.int32) + offset)
            rows.append(exposed)
    lattice = np.concatenate(corners).reshape(-1, 3)
    return lattice, np.arange(len(lattice), dtype=np.int32).reshape(-1, 4), np.concatenate(rows)
