"""Polygon file: the occupied voxels as a mesh of cubes or as points, colored."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from ..core.atomic_files import write_whole
from ..core.errors import ExportError
from ..core.ply_files import write_ply
from ..core.types import OCCUPIED, Occupancy
from ..occupancy.surface_faces import find_exposed_faces
from ..query.scan_map import Map
from ..query.word_query import QueryResult
from ..viewer.palette import assign_class_colors, color_by_height, color_by_value, highlight_regions
from .export_frames import Frame, PlacedVoxels, VoxelOptions, place_voxels

REQUIRES: tuple[str, ...] = ()
ENDINGS = (".ply",)

ColorBy = Literal["rgb", "class", "height", "probability"]
"""What the color of an occupied voxel shows."""


class Options(VoxelOptions, frozen=True):
    """Shape and color."""

    frame: Frame = "map"
    form: Literal["cubes", "points"] = "cubes"
    """"cubes" for a mesh of the faces between occupied and other voxels, "points" for the voxels' centers."""
    color: ColorBy = "rgb"
    """"rgb" for the surface's own color, "class" for the best class, "height" above the lowest voxel, or "probability"
    of occupancy, 0 to 1; the last two go from dark blue to yellow."""


def write(scan_map: Map, path: Path, options: Options) -> None:
    """Writes the occupied voxels. Raises ExportError for a map without occupied voxels."""
    _refuse_empty(scan_map.occupancy)
    there = place_voxels(scan_map, options.frame, box=options.box)
    _refuse_empty(there.occupancy)
    _write(there.occupancy, choose_colors(scan_map, there, options.color), path, options.form, there.described())


def write_query_ply(occupancy: Occupancy, results: list[QueryResult], path: Path, overwrite: bool = False) -> None:
    """Writes all occupied voxels as cubes: the regions of each word in a strong color of their own, the others pale.
    Raises ExportError."""
    _refuse_empty(occupancy)
    colors = highlight_regions(occupancy.colors, [result.regions for result in results])
    write_whole(path, lambda target: _write(occupancy, colors, target, "cubes"), overwrite)


def _refuse_empty(occupancy: Occupancy) -> None:
    if len(occupancy.colors) == 0:
        raise ExportError("The map has no occupied voxels to write.")


def choose_colors(scan_map: Map, there: PlacedVoxels, by: str) -> NDArray[np.uint8]:
    """Returns the (V, 3) color of each occupied voxel of a placed map. by: one of ``ColorBy``."""
    occupancy = there.occupancy
    if by == "class":
        return assign_class_colors(scan_map.vocabulary)[scan_map.labels()[there.rows]]
    if by == "height":
        return color_by_height(occupancy, there.T_frame_map[:3, :3] @ scan_map.up)
    if by == "probability":
        return color_by_value(occupancy.probability[occupancy.state == OCCUPIED])
    return occupancy.colors


def _write(
    occupancy: Occupancy, colors: NDArray[np.uint8], path: Path, form: str, described: dict[str, Any] | None = None
) -> None:
    if form == "points":
        points = occupancy.centers(occupancy.occupied_voxels(), occupancy.occupied_edges()).astype(np.float32)
        write_colored_ply(path, points, colors, None, described)
    else:
        vertices, quads, rows = find_exposed_faces(occupancy)
        write_colored_ply(path, vertices, np.repeat(colors[rows], 4, axis=0), quads, described)


def write_colored_ply(
    path: Path,
    points: NDArray[np.float32],
    colors: NDArray[np.uint8],
    quads: NDArray[np.int32] | None = None,
    described: dict[str, Any] | None = None,
) -> None:
    """Writes a binary little-endian PLY with colored vertices and, if given, quads. The description goes into comments.
    Raises OSError."""
    vertices = np.empty(
        len(points), [*((name, "<f4") for name in "xyz"), *((name, "u1") for name in ("red", "green", "blue"))]
    )
    for name, column in zip(vertices.dtype.names or (), (*points.T, *colors.T), strict=True):
        vertices[name] = column
    comments = ["freeocc3d", *(f"{name} {json.dumps(value)}" for name, value in (described or {}).items())]
    write_ply(path, vertices, quads, comments)
