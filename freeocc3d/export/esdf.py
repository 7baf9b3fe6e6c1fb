"""Euclidean signed distances to the nearest obstacle, for trajectory optimizers: NumPy arrays, or OpenVDB (`.vdb`).

Keys of the arrays:
    distance (X, Y, Z) float32, meters, from a voxel's center to the face of the nearest obstacle: to its center, less
    half a voxel; negative within obstacles, to the nearest voxel that is no obstacle; NaN for unknown with
    `unknown=nan`
    state (X, Y, Z) uint8: 0 free, 1 occupied, 255 unknown; origin (3,) lower corner of voxel (0, 0, 0); voxel_size
    meters; frame; T_frame_map and T_world_map (4, 4)
A .vdb has one grid `distance`. Its active voxels are the known ones; others read 0. Index 0 is a voxel's center.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ..core.errors import ExportError
from ..core.types import BLOCK, FREE, OCCUPIED, UNKNOWN, Occupancy
from ..query.scan_map import Map
from .distance_transform import LONGEST, transform_signed
from .export_frames import Box, PlacedVoxels, VoxelOptions, find_world, place_voxels
from .openvdb_files import write_vdb

REQUIRES: tuple[str, ...] = ()
ENDINGS = (".npz", ".vdb")

_BYTES_A_VOXEL = 6  # distance, state and the obstacle mask
_LARGEST = 2 << 30
_BLOCKS_AT_ONCE = 1024
_LOCAL = np.stack(np.unravel_index(np.arange(BLOCK**3), (BLOCK,) * 3), axis=1)
UNKNOWN_IS = "free", "obstacle", "nan"


class Options(VoxelOptions, frozen=True):
    """Frame, and the meaning of unknown space. A name ending in .npz gives arrays, one in .vdb an OpenVDB grid."""

    unknown: Literal["free", "obstacle", "nan"] = "free"
    """Unknown space: "free" is no obstacle, "obstacle" is an obstacle, "nan" is no obstacle and has no distance."""
    box: Box | None = None
    """Lower and upper corner of a box in the frame, x0, y0, z0, x1, y1, z1 in meters. Only voxels with centers in the
    box are written, and only obstacles in it count; null = all."""


def write(scan_map: Map, path: Path, options: Options) -> None:
    """Writes the distances. Raises ExportError if the map has no obstacle, or if the
    distances do not fit into 2 GiB."""
    there = place_voxels(scan_map, options.frame, one_size=True, box=options.box)
    distance, state, origin = signed_distances(there.occupancy, options.unknown)
    if path.suffix.lower() == ".vdb":
        _write_grid(path, there, distance)
        return
    with path.open("wb") as stream:
        np.savez_compressed(
            stream,
            distance=distance,
            state=state,
            origin=origin,
            voxel_size=np.float64(there.occupancy.voxel_size),
            frame=np.array(options.frame),
            T_frame_map=there.T_frame_map,
            T_world_map=find_world(scan_map, there.T_frame_map),
        )


def _write_grid(path: Path, there: PlacedVoxels, distance: NDArray[np.float32]) -> None:
    """Writes the distances of the known voxels, block by block."""
    occupancy = there.occupancy
    known = occupancy.state != UNKNOWN
    low = known_box(occupancy)[0]
    values = np.zeros(known.shape, np.float32)
    for start in range(0, len(known), _BLOCKS_AT_ONCE):
        part = slice(start, start + _BLOCKS_AT_ONCE)
        at = occupancy.keys[part, None] * BLOCK + _LOCAL - low
        values[part][known[part]] = distance[tuple(at[known[part]].T)]
    described = {name: json.dumps(value) for name, value in there.described().items()}
    center = occupancy.origin + 0.5 * occupancy.voxel_size
    write_vdb(path, "distance", occupancy.keys, values, known, occupancy.voxel_size, center, described)


def signed_distances(
    occupancy: Occupancy, unknown: str
) -> tuple[NDArray[np.float32], NDArray[np.uint8], NDArray[np.float64]]:
    """Returns the exact (X, Y, Z) distances and the states over the box of all known voxels, and the (3,) lower corner
    of the box. Voxels must be of one size. Raises ExportError as ``write`` does."""
    state, origin = states(occupancy)
    obstacle = state != FREE if unknown == "obstacle" else state == OCCUPIED
    if not obstacle.any():
        raise ExportError("The map has no obstacle, so there are no distances.")
    distance = transform_signed(obstacle)
    distance[obstacle] += np.float32(0.5)
    np.subtract(distance, np.float32(0.5), out=distance, where=~obstacle)
    distance *= np.float32(occupancy.voxel_size)
    if unknown == "nan":
        distance[state == UNKNOWN] = np.nan
    return distance, state, origin


def states(occupancy: Occupancy) -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
    """Returns the (X, Y, Z) states over the box of all known voxels, and the box's lower corner. Voxels must be of one
    size. Raises ExportError if distances over the box do not fit into 2 GiB, or if nothing is known."""
    low, high = known_box(occupancy)
    shape = high - low
    size = _BYTES_A_VOXEL * float(np.prod(shape.astype(np.float64)))
    if size > _LARGEST or shape.max() > LONGEST:
        raise ExportError(
            f"Distances in {' x '.join(map(str, shape))} voxels take {size / 2**30:.1f} GiB of memory: export a part "
            "of the map with --set box=…, or reconstruct it with larger voxels."
        )
    grid = np.full(shape, UNKNOWN, np.uint8)
    for start in range(0, len(occupancy.keys), _BLOCKS_AT_ONCE):
        part = slice(start, start + _BLOCKS_AT_ONCE)
        known = occupancy.state[part] != UNKNOWN
        at = occupancy.keys[part, None] * BLOCK + _LOCAL - low
        grid[tuple(at[known].T)] = occupancy.state[part][known]
    return grid, occupancy.origin + low * occupancy.voxel_size


def known_box(occupancy: Occupancy) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Returns the (3,) index of the first voxel in the box of all known voxels, and the (3,) index after the last.
    Voxels must be of one size. Raises ExportError if nothing is known."""
    known = (occupancy.state != UNKNOWN).reshape(-1, BLOCK, BLOCK, BLOCK)
    if not known.any():
        raise ExportError("The map has no known voxels, so there are no distances to write.")
    low, high = np.zeros(3, np.int64), np.zeros(3, np.int64)
    for axis in range(3):
        others = tuple(1 + other for other in range(3) if other != axis)
        block, layer = np.nonzero(known.any(axis=others))
        index = occupancy.keys[block, axis].astype(np.int64) * BLOCK + layer
        low[axis], high[axis] = index.min(), index.max() + 1
    return low, high
