"""Moves voxels to another lattice, which is turned and shifted against the first."""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray

from ..core.transforms import invert, transform
from ..core.types import BLOCK, FREE, OCCUPIED, UNKNOWN, Occupancy
from ..core.voxel_keys import contains, pack_voxels, unpack_voxels

_BLOCKS_AT_ONCE = 1024
_LOCAL = np.stack(np.unravel_index(np.arange(BLOCK**3), (BLOCK,) * 3), axis=1)


def resample_occupancy(
    occupancy: Occupancy, T_new_old: NDArray[np.float64], origin: NDArray[np.float64]
) -> tuple[Occupancy, NDArray[np.int64]]:
    """Returns a map of one voxel size on a lattice of the same size in another frame, without features, and for each
    occupied voxel the row of the old occupied voxel that it stands for.

    T_new_old: (4, 4), rigid.  origin: (3,) lower corner of the new voxel (0, 0, 0), in the new frame. A new voxel takes
    the state of the old voxel that holds its center. A new voxel that holds the center of an old occupied voxel is
    occupied too, so that surfaces get no holes and thin things are not lost.
    """
    T_old_new = invert(T_new_old)
    size, packed = occupancy.voxel_size, pack_voxels(occupancy.keys)
    order = np.argsort(packed)
    ascending = packed[order]
    rows_of = np.full(occupancy.state.shape, -1, np.int32)
    rows_of[occupancy.state == OCCUPIED] = np.arange(len(occupancy.colors))
    keys = _covering(occupancy, T_new_old, origin)

    states = np.full((len(keys), BLOCK**3), UNKNOWN, np.uint8)
    probability = np.zeros((len(keys), BLOCK**3), np.float32)
    rows = np.full((len(keys), BLOCK**3), -1, np.int32)
    corners = (
        transform(T_old_new, origin + keys * BLOCK * size) - occupancy.origin
    )  # of the new blocks, on the old lattice
    offsets = (_LOCAL + 0.5) @ T_old_new[:3, :3].T
    for start in range(0, len(keys), _BLOCKS_AT_ONCE):
        part = slice(start, start + _BLOCKS_AT_ONCE)
        voxel = np.floor(corners[part, None] / size + offsets).astype(np.int64).reshape(-1, 3)
        block = pack_voxels(voxel >> 3)
        found = contains(ascending, block)
        at = order[np.searchsorted(ascending, block[found])]
        local = (voxel[found] & 7) @ np.array((64, 8, 1))
        for new, old in ((states, occupancy.state), (probability, occupancy.probability), (rows, rows_of)):
            values = new[part].reshape(-1)
            values[found] = old[at, local]
            new[part] = values.reshape(-1, BLOCK**3)

    centers = transform(T_new_old, occupancy.centers(occupancy.occupied_voxels()))
    voxel = np.floor((centers - origin) / size).astype(np.int64)
    row = np.searchsorted(pack_voxels(keys), pack_voxels(voxel >> 3))
    local = (voxel & 7) @ np.array((64, 8, 1))
    missed = states[row, local] != OCCUPIED
    row, local = row[missed], local[missed]
    states[row, local] = OCCUPIED
    rows[row, local] = np.flatnonzero(missed)
    probability[row, local] = occupancy.probability[occupancy.state == OCCUPIED][missed]

    known = (states != UNKNOWN).any(axis=1)
    keys, states, rows, probability = keys[known], states[known], rows[known], probability[known]
    row_of_occupied = rows[states == OCCUPIED].astype(np.int64)
    return Occupancy(
        voxel_size=size,
        origin=np.asarray(origin, np.float64),
        keys=keys,
        probability=probability,
        free=(states == FREE).astype(np.uint16),
        hits=(states == OCCUPIED).astype(np.uint16),
        state=states,
        features=np.zeros((len(row_of_occupied), 0), np.float16),
        colors=occupancy.colors[row_of_occupied],
    ), row_of_occupied


def _covering(occupancy: Occupancy, T_new_old: NDArray[np.float64], origin: NDArray[np.float64]) -> NDArray[np.int32]:
    """Returns the (B', 3) keys, in packed order, of the new blocks that an old block may reach into."""
    edge = BLOCK * occupancy.voxel_size
    R, t = T_new_old[:3, :3], T_new_old[:3, 3]
    center = (occupancy.origin + (occupancy.keys + 0.5) * edge) @ R.T + t - origin
    reach = 0.5 * edge * np.abs(R).sum(axis=1)
    low = np.floor((center - reach) / edge).astype(np.int64)
    high = np.floor((center + reach) / edge).astype(np.int64)
    most = (high - low).max(axis=0, initial=0) + 1
    parts = [
        pack_voxels((low + step)[(low + step <= high).all(axis=1)])
        for step in itertools.product(*(range(int(n)) for n in most))
    ]
    return unpack_voxels(np.unique(np.concatenate(parts)))
