"""NumPy arrays: a dense grid of free, occupied and unknown, or lists of voxels.

Keys of the dense form (`form=dense`), over the box of all known voxels:
    occupancy (X, Y, Z) uint8: 0 free, 1 occupied, 255 unknown
    probability (X, Y, Z) float16: alpha of the voxel's center
    labels (X, Y, Z) uint8: 0 free, k = classes[k - 1], len(classes) + 1 = occupied by an unknown class, 255 unknown
    classes (C,) names, C = 0 without a vocabulary; no more than 253, so that every label fits into a byte
    origin (3,) lower corner of voxel (0, 0, 0), meters; voxel_size meters; frame, the name of the arrays' frame;
    T_frame_map (4, 4) from the map's frame to the arrays'; T_world_map (4, 4) from the arrays' frame to the world of
    the map's manifest, that of given poses
Keys of the sparse form: voxels (V, 3) int32 indices, state (V,) uint8 as above, probability (V,), labels (V,), classes,
origin, voxel_size, frame, T_frame_map, T_world_map. In both forms, voxel (i, j, k) covers origin + [i, i + 1) *
voxel_size. In a map of several voxel sizes, voxel_size is the smallest. In the dense form, a larger voxel fills all
cells that it covers. The sparse form then also has edges (V,) int32: voxel (i, j, k) covers origin + [i, i + edge) *
voxel_size.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from ..core.errors import ExportError
from ..core.types import FREE, OCCUPIED, UNKNOWN, Occupancy
from ..query.scan_map import Map
from .export_frames import Frame, VoxelOptions, find_world, place_voxels

REQUIRES: tuple[str, ...] = ()
ENDINGS = (".npz",)

_LARGEST_DENSE = 2 << 30
_MOST_CLASSES = 253  # 0 is free, up to 254 means "nothing known", 255 is unknown


class Options(VoxelOptions, frozen=True):
    """Shape of the arrays."""

    frame: Frame = "map"
    form: Literal["dense", "sparse"] = "dense"
    """"dense" for a grid over the map's box, "sparse" for lists of its known voxels."""


def write(scan_map: Map, path: Path, options: Options) -> None:
    """Writes the arrays. Raises ExportError if the dense grid does not fit into memory."""
    form = dense if options.form == "dense" else sparse
    classes = scan_map.vocabulary[:_MOST_CLASSES]
    there = place_voxels(scan_map, options.frame, box=options.box)
    arrays = form(there.occupancy, scan_map.labels()[there.rows], len(classes))
    arrays |= {
        "voxel_size": np.float64(there.occupancy.finest),
        "frame": np.array(options.frame),
        "T_world_map": find_world(scan_map, there.T_frame_map),
        "T_frame_map": there.T_frame_map,
        "classes": np.array(classes, np.str_),
    }
    with path.open("wb") as stream:
        np.savez_compressed(stream, **arrays)


def sparse(occupancy: Occupancy, labels: NDArray[np.uint8], classes: int) -> dict[str, Any]:
    """Returns the known voxels, row by row. labels: (V,) 0…classes of the occupied voxels, 0 = nothing known."""
    block, local = np.nonzero(occupancy.state != UNKNOWN)
    state = occupancy.state[block, local]
    offsets = np.stack((local // 64, local // 8 % 8, local % 8), axis=1)
    label = np.zeros(len(state), np.uint8)
    label[state == OCCUPIED] = np.where(labels > 0, labels, classes + 1)
    edges = (1 << (occupancy.deepest - occupancy.levels[block].astype(np.int32))).astype(np.int32)
    return {
        "voxels": ((occupancy.keys[block] * 8 + offsets) * edges[:, None]).astype(np.int32),
        **({"edges": edges} if occupancy.deepest else {}),
        "state": state,
        "probability": occupancy.probability[block, local].astype(np.float16),
        "labels": label,
        "origin": occupancy.origin,
    }


def dense(occupancy: Occupancy, labels: NDArray[np.uint8], classes: int) -> dict[str, Any]:
    """Returns the grid over the box of all known voxels; an empty map gives arrays of shape (0, 0, 0)."""
    known = sparse(occupancy, labels, classes)
    voxels, edges = known["voxels"], known.get("edges", np.ones(len(known["voxels"]), np.int32))
    low = voxels.min(axis=0) if len(voxels) else np.zeros(3, np.int32)
    shape = tuple(int(n) for n in ((voxels + edges[:, None]).max(axis=0) - low if len(voxels) else np.zeros(3, int)))
    size = 4 * int(np.prod([float(n) for n in shape]))
    if size > _LARGEST_DENSE:
        raise ExportError(
            f"A dense grid of {' x '.join(map(str, shape))} voxels takes {size / 2**30:.1f} GiB: use --set form=sparse."
        )
    grid: dict[str, NDArray[Any]] = {
        "occupancy": np.full(shape, UNKNOWN, np.uint8),
        "probability": np.zeros(shape, np.float16),
        "labels": np.full(shape, UNKNOWN, np.uint8),
    }
    values = {
        "occupancy": np.where(known["state"] == FREE, FREE, OCCUPIED),
        "probability": known["probability"],
        "labels": known["labels"],
    }
    for edge in np.unique(edges):
        own = edges == edge
        for part in np.ndindex(edge, edge, edge):
            at = tuple((voxels[own] - low + part).T)
            for name, value in values.items():
                grid[name][at] = value[own]
    return {**grid, "origin": occupancy.origin + low * occupancy.finest}
