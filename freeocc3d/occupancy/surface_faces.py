"""The surface of the occupied voxels, for meshes and pictures."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..core.types import Occupancy
from ..core.voxel_keys import contains, pack_voxels


def find_exposed_faces(
    occupancy: Occupancy, chosen: NDArray[np.bool_] | None = None
) -> tuple[NDArray[np.float32], NDArray[np.int32], NDArray[np.int64]]:
    """Returns the faces between occupied voxels and all others: (4 F, 3) vertices in meters, (F, 4) quads that index
    them, counter-clockwise from outside, and the (F,) row of the occupied voxel of each face.

    chosen: (V,) the occupied voxels to draw, as if no others existed; all by default.
    """
    voxels, edges = occupancy.occupied_voxels(), occupancy.occupied_edges()
    chosen_rows = np.arange(len(voxels)) if chosen is None else np.flatnonzero(chosen)
    corners, quads, rows = build_faces(voxels[chosen_rows], edges[chosen_rows])
    vertices = (occupancy.origin + corners * occupancy.finest).astype(np.float32)
    return vertices, quads, chosen_rows[rows]


def build_faces(
    voxels: NDArray[np.integer], edges: NDArray[np.integer] | None = None
) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.int64]]:
    """Returns the faces of voxels as ``find_exposed_faces`` does, but with (4 F, 3) corners on the lattice.

    voxels: (V, 3) lower corners, |i| < 2^20.  edges: (V,) powers of two that divide the corners; 1 by default. A face
    toward smaller voxels is always drawn, whichever of them exist.
    """
    edges = np.ones(len(voxels), np.int32) if edges is None else edges
    sizes = np.unique(edges)
    ascending = {size: np.sort(pack_voxels(voxels[edges == size] // size)) for size in sizes}
    corners, rows = [], []
    for size in sizes:
        own = np.flatnonzero(edges == size)
        for axis in range(3):
            for side in (0, 1):
                neighbor = voxels[own].astype(np.int64)
                neighbor[:, axis] += size * (2 * side - 1)
                hidden = np.zeros(len(own), bool)
                for other in sizes[sizes >= size]:  # the neighbor itself, or a larger voxel that holds it
                    hidden |= contains(ascending[other], pack_voxels(neighbor // other))
                exposed = own[~hidden]
                b, c = (axis + 1) % 3, (axis + 2) % 3
                turn = [(0, 0), (1, 0), (1, 1), (0, 1)] if side else [(0, 0), (0, 1), (1, 1), (1, 0)]
                offset = np.zeros((4, 3), np.int32)
                offset[:, axis], offset[:, [b, c]] = side, turn
                corners.append(voxels[exposed, None].astype(np.int32) + size.astype(np.int32) * offset)
                rows.append(exposed)
    if not rows:
        return np.zeros((0, 3), np.int32), np.zeros((0, 4), np.int32), np.zeros(0, np.int64)
    lattice = np.concatenate(corners).reshape(-1, 3)
    return lattice, np.arange(len(lattice), dtype=np.int32).reshape(-1, 4), np.concatenate(rows)
