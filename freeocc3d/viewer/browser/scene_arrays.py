"""What the page needs of a map to draw it: voxels, Gaussians, the camera path, the keyframes' cameras."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.errors import FreeOccError, MapError
from ...core.types import FREE, OCCUPIED, UNKNOWN, Gaussians, Occupancy
from ...core.voxel_keys import contains, pack_voxels
from ...query.scan_map import Map
from ..palette import assign_class_colors

_REACH = 32767
"""Farthest voxel from the map's middle, in edges of the smallest: the page holds voxels as 16-bit numbers."""

Arrays = dict[str, NDArray[Any]]


def describe_scene(scan_map: Map, most_gaussians: int | None = None) -> tuple[dict[str, Any], Arrays]:
    """Returns the JSON document and the arrays of a map's packet.

    most_gaussians: draw the largest only.  Arrays, in the map's frame, meters: those of ``_voxels``; ``means`` (N, 3),
    ``scales`` (N, 3) and ``quats_wxyz`` (N, 4) float32 or int8 / 127, ``opacities`` (N,) uint8 / 255,
    ``splat_colors`` (N, 3) of Gaussians; ``path`` (P, 3) float32 camera centers; ``T_map_cam`` (K, 4, 4) float32 and
    ``cameras`` (K, 6) float32 width, height, fx, fy, cx, cy of keyframes. Raises MapError for a damaged map.
    """
    counts, trajectory = scan_map.manifest.counts, scan_map.trajectory
    voxel_meta, arrays = _voxels(scan_map)
    arrays |= _splats(scan_map.gaussians, most_gaussians)
    T = trajectory.T_world_cam[trajectory.has_pose]
    cameras = [camera for _, camera in scan_map.keyframes.views()]
    arrays["path"] = T[:, :3, 3].astype(np.float32)
    arrays["T_map_cam"] = trajectory.T_world_keyframe.astype(np.float32).reshape(-1, 16)
    arrays["cameras"] = np.array([(c.width, c.height, c.fx, c.fy, c.cx, c.cy) for c in cameras], np.float32).reshape(
        -1, 6
    )
    meta = {
        "title": scan_map.path.resolve().name,
        "capture": Path(scan_map.manifest.capture.path).name,
        "metric": scan_map.metric,
        "upright": True,
        "T_view_map": scan_map.T_gravity_map.tolist(),
        "keyframes": trajectory.keyframes.tolist(),
        "frames": {"posed": counts.frames_with_pose, "all": counts.frames},
        "gaussians": {"drawn": len(arrays["means"]), "all": counts.gaussians},
        "encoder": scan_map.manifest.encoder.name,
        "voxels": voxel_meta,
        **_classes(scan_map, arrays),
    }
    return meta, arrays


def describe_space(scan_map: Map) -> tuple[dict[str, Any], Arrays]:
    """Returns the document and arrays of what is not occupied: ``free`` (F, 4) int16, seen through, and ``unknown``
    (U, 4) int16, never seen though next to free space, as ``_voxels`` gives voxels. Raises MapError for a map that
    reaches too far."""
    occupancy = scan_map.occupancy
    low = _lowest(occupancy)
    free = occupancy.voxels(FREE)
    lattices = {
        "free": (free, occupancy.edges(FREE)),
        "unknown": _frontier(occupancy, free),
    }
    return {"free": len(free)}, {name: _packed(*lattice, low) for name, lattice in lattices.items()}


def _voxels(scan_map: Map) -> tuple[dict[str, Any], Arrays]:
    """Returns what describes the occupied voxels, and their arrays in row order: ``voxels`` (V, 4) int16: lower corner
    and edge in units of the smallest edge, from the lowest corner; ``colors`` (V, 3) uint8; ``probability`` (V,) uint8
    / 255; ``hits``, ``seen_through`` (V,) uint16, numbers of depth images."""
    occupancy = scan_map.occupancy
    voxels, edges = occupancy.occupied_voxels(), occupancy.occupied_edges()
    meta, arrays = describe_voxels(voxels, edges, _lowest(occupancy), occupancy.origin, occupancy.finest)
    block, local = np.nonzero(occupancy.state == OCCUPIED)
    return meta, arrays | {
        "colors": occupancy.colors,
        "probability": np.rint(255 * np.clip(occupancy.probability[block, local], 0, 1)).astype(np.uint8),
        "hits": occupancy.hits[block, local],
        "seen_through": occupancy.free[block, local],
    }


def describe_voxels(
    voxels: NDArray[np.int32],
    edges: NDArray[np.int32],
    low: NDArray[np.int64],
    origin: NDArray[np.float64],
    unit: float,
) -> tuple[dict[str, Any], Arrays]:
    """Returns what describes (V, 3) lower corners and (V,) edges, in units, and the array ``voxels`` of them, counted
    from the corner ``low``. origin: (3,) of corner 0, meters.  unit: meters."""
    meta = {
        "count": len(voxels),
        "origin": (origin + low * unit).tolist(),
        "unit": unit,
        "sizes": [unit * edge for edge in np.unique(edges).tolist()] or [unit],
    }
    return meta, {"voxels": _packed(voxels, edges, low)}


def _lowest(occupancy: Occupancy) -> NDArray[np.int64]:
    """Returns the (3,) lowest corner of all blocks, in the smallest edges. Raises MapError if they reach too far."""
    known = np.concatenate([occupancy.voxels(state) for state in (FREE, OCCUPIED)])
    if not len(known):
        return np.zeros(3, np.int64)
    low, high = known.min(axis=0).astype(np.int64), known.max(axis=0).astype(np.int64)
    if (high - low).max() + 2 > _REACH:
        raise MapError(f"The map reaches over {(high - low).max():,} voxels; the viewer draws {_REACH:,} at most.")
    return low - 1


def _packed(voxels: NDArray[np.int32], edges: NDArray[np.int32], low: NDArray[np.int64]) -> NDArray[np.int16]:
    return np.concatenate((voxels - low, edges[:, None]), axis=1).astype(np.int16)


def _frontier(occupancy: Occupancy, free: NDArray[np.int32]) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Returns corners and edges of the unknown voxels with a free voxel beside a face. Blocks of several sizes are
    compared where their voxels have the same size."""
    unknown, edges = occupancy.voxels(UNKNOWN), occupancy.edges(UNKNOWN)
    known = np.unique(pack_voxels(free))
    beside = np.zeros(len(unknown), bool)
    for axis in range(3):
        for side in (-1, 1):
            moved = unknown.copy()
            moved[:, axis] += side * edges
            beside |= contains(known, pack_voxels(moved))
    return unknown[beside], edges[beside]


def _splats(gaussians: Gaussians, most: int | None) -> Arrays:
    kept = np.arange(len(gaussians))
    if most is not None and len(gaussians) > most:
        area = np.sort(gaussians.scales, axis=1)[:, 1:].prod(axis=1) * gaussians.opacities
        kept = np.sort(np.argsort(-area, kind="stable")[:most])
    chosen = gaussians[kept]
    return {
        "means": chosen.means.astype(np.float32),
        "scales": chosen.scales.astype(np.float32),
        "quats_wxyz": np.rint(127 * chosen.quats_wxyz).astype(np.int8),
        "opacities": np.rint(255 * np.clip(chosen.opacities, 0, 1)).astype(np.uint8),
        "splat_colors": chosen.colors,
    }


def _classes(scan_map: Map, arrays: Arrays) -> dict[str, Any]:
    """Returns names and colors of the classes that the map's voxels have, and adds their (V,) uint8 numbers to
    ``arrays`` (0 = nothing known); why there are none, if a map with a vocabulary cannot be asked."""
    try:
        names = scan_map.vocabulary[:253]
        labels = scan_map.labels() if names else np.zeros(0, np.uint8)
    except FreeOccError as error:
        return {"classes": [], "no_classes": str(error)}
    present = np.bincount(labels, minlength=len(names) + 1)
    colors = assign_class_colors(names)
    if names:
        arrays["classes"] = labels
    return {
        "classes": [
            {"number": k, "name": "nothing known" if k == 0 else names[k - 1], "voxels": int(present[k]),
             "color": colors[k].tolist()}
            for k in np.argsort(-present, kind="stable").tolist() if present[k]
        ]
    }  # fmt: skip
