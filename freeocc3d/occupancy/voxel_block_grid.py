"""Occupancy to and from Open3D's ``t.geometry.VoxelBlockGrid``, block by block; no dense array in between.

Open3D's blocks hold their values in the order [z, y, x], ours in the order [x, y, z]. Open3D takes values to stand at
``index * voxel_size``; ours stand at voxels' centres, ``origin + (index + 1/2) * voxel_size``: that is what to add to
coordinates that Open3D gives.
"""

from __future__ import annotations

import numpy as np
import open3d as o3d
import open3d.core as o3c
from numpy.typing import NDArray

from ..core.errors import FreeOccError
from ..core.types import BLOCK, OCCUPIED, Occupancy
from ..core.voxel_keys import pack_voxels

_PER_VOXEL = {"probability": np.float32, "free": np.uint16, "hits": np.uint16, "state": np.uint8}
_OF_OCCUPIED = {"color": np.uint8, "feature": np.float32}
_DTYPES = {np.float32: o3c.float32, np.uint16: o3c.uint16, np.uint8: o3c.uint8}


def to_voxel_block_grid(
    occupancy: Occupancy, features: bool = True, device: str = "cpu:0"
) -> o3d.t.geometry.VoxelBlockGrid:
    """The same blocks in a grid with attributes "probability", "free", "hits", "state", "color" and "feature".

    features: False leaves "feature" out, which takes 2 D KB for every block, be its voxels occupied or not.
    Raises FreeOccError for a map of several voxel sizes, which Open3D's grid cannot hold.
    """
    if occupancy.deepest:
        raise FreeOccError("A VoxelBlockGrid holds voxels of one size: make them so first, with levels.uniform.")
    occupied = occupancy.state == OCCUPIED
    arrays = {name: getattr(occupancy, name)[:, :, None] for name in _PER_VOXEL}
    arrays["color"] = _spread(occupancy.colors, occupied)
    if features and occupancy.features.shape[1]:
        arrays["feature"] = _spread(np.asarray(occupancy.features), occupied)
    kinds = _PER_VOXEL | _OF_OCCUPIED
    where = o3c.Device(device)
    grid = o3d.t.geometry.VoxelBlockGrid(
        tuple(arrays),
        tuple(_DTYPES[kinds[name]] for name in arrays),
        tuple((array.shape[2],) for array in arrays.values()),
        occupancy.voxel_size,
        BLOCK,
        max(len(occupancy.keys), 1),
        where,
    )
    if len(occupancy.keys):
        rows, _ = grid.hashmap().activate(o3c.Tensor(occupancy.keys, device=where))
        for name, array in arrays.items():
            blocks = array.reshape(-1, BLOCK, BLOCK, BLOCK, array.shape[2]).transpose(0, 3, 2, 1, 4)
            values = np.ascontiguousarray(blocks, kinds[name])
            grid.attribute(name)[rows.to(o3c.int64)] = o3c.Tensor(values, device=where)
    return grid


def from_voxel_block_grid(
    grid: o3d.t.geometry.VoxelBlockGrid, voxel_size: float, origin: NDArray[np.float64] | None = None
) -> Occupancy:
    """The occupancy that a grid with at least "probability" and "state" holds, its blocks in the order of their keys.

    Blocks of 16, 24, … voxels an edge are cut into ours. voxel_size, origin: not kept by Open3D; origin is the lower
    corner of voxel (0, 0, 0), by default the world's origin. Raises FreeOccError for a grid of other attributes.
    """
    rows = grid.hashmap().active_buf_indices().to(o3c.int64)
    keys = grid.hashmap().key_tensor()[rows].cpu().numpy().astype(np.int64)
    arrays = {}
    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        for name in (*_PER_VOXEL, *_OF_OCCUPIED):
            try:
                values = grid.attribute(name)[rows].cpu().numpy()
            except RuntimeError:  # there is none: Open3D gives a tensor of nothing, which refuses everything
                continue
            arrays[name], places = _cut(values)
    if not {"probability", "state"} <= arrays.keys():
        raise FreeOccError("The VoxelBlockGrid has no attributes 'probability' and 'state': it holds no occupancy.")
    edge = round(len(places) ** (1 / 3))
    keys = (keys[:, None] * edge + places[None]).reshape(-1, 3)
    order = np.argsort(pack_voxels(keys))
    per_voxel = {
        name: arrays[name][order, :, 0].astype(kind) if name in arrays else np.zeros((len(keys), BLOCK**3), kind)
        for name, kind in _PER_VOXEL.items()
    }
    occupied = per_voxel["state"] == OCCUPIED
    count = int(np.count_nonzero(occupied))
    colors = arrays["color"][order][occupied] if "color" in arrays else np.zeros((count, 3))
    features = arrays["feature"][order][occupied] if "feature" in arrays else np.zeros((count, 0))
    return Occupancy(
        voxel_size=voxel_size,
        origin=np.zeros(3) if origin is None else np.asarray(origin, np.float64),
        keys=keys[order].astype(np.int32),
        colors=colors.astype(np.uint8),
        features=features.astype(np.float16),
        **per_voxel,
    )


def _spread(values: NDArray[np.generic], occupied: NDArray[np.bool_]) -> NDArray[np.generic]:
    """(B, 512, C) with the rows (V, C) of occupied voxels at their places, zeros elsewhere."""
    out = np.zeros((*occupied.shape, values.shape[1]), values.dtype)
    out[occupied] = values
    return out


def _cut(values: NDArray[np.generic]) -> tuple[NDArray[np.generic], NDArray[np.int64]]:
    """Open3D's blocks (B, R, R, R, C) as ours, (B (R / 8)^3, 512, C), and the place of each of the (R / 8)^3 within
    its block. Raises FreeOccError if 8 does not divide R."""
    resolution, channels = values.shape[1], values.shape[4]
    parts = resolution // BLOCK
    if parts * BLOCK != resolution:
        raise FreeOccError(f"The VoxelBlockGrid has blocks of {resolution} voxels an edge: 8, 16, 24, … are read.")
    cut = values.reshape(-1, parts, BLOCK, parts, BLOCK, parts, BLOCK, channels)
    ours = cut.transpose(0, 5, 3, 1, 6, 4, 2, 7).reshape(-1, BLOCK**3, channels)
    return ours, np.stack(np.unravel_index(np.arange(parts**3), (parts,) * 3), axis=1)
