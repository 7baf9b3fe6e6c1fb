"""Polygon file: the occupied voxels as a mesh of cubes or as points, coloured."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import ConfigError, ExportError
from ..files import write_whole
from ..occupancy.faces import exposed_faces
from ..palette import class_colors, height_colors, highlighted, ramp
from ..query import QueryResult
from ..store import Map
from ..types import OCCUPIED, Occupancy

REQUIRES: tuple[str, ...] = ()

_COLORS = "rgb", "class", "height", "probability"


@dataclass(frozen=True)
class Options:
    """Shape and colour."""

    form: str = "cubes"
    """"cubes" for a mesh of the faces between occupied and other voxels, "points" for voxel centres."""
    color: str = "rgb"
    """"rgb" for the surface's own colour, "class" for the class that fits best, "height" above the lowest voxel, or
    "probability" of being occupied, 0 to 1; the last two from dark blue to yellow."""

    def __post_init__(self) -> None:
        if self.form not in ("cubes", "points"):
            raise ConfigError(f"'form' must be cubes or points, got '{self.form}'.")
        if self.color not in _COLORS:
            raise ConfigError(f"'color' must be {', '.join(_COLORS[:-1])} or {_COLORS[-1]}, got '{self.color}'.")


def write(scan_map: Map, path: Path, options: Options) -> None:
    """Write the occupied voxels. Raises ExportError for a map without any."""
    _refuse_empty(scan_map.occupancy)
    _write(scan_map.occupancy, _colors(scan_map, options.color), path, options.form)


def write_query_ply(occupancy: Occupancy, results: list[QueryResult], path: Path, overwrite: bool = False) -> None:
    """Write all occupied voxels as cubes, those of the results' regions in one strong colour a word, the others pale.
    Raises ExportError."""
    _refuse_empty(occupancy)
    colors = highlighted(occupancy.colors, [result.regions for result in results])
    write_whole(path, lambda target: _write(occupancy, colors, target, "cubes"), overwrite)


def _refuse_empty(occupancy: Occupancy) -> None:
    if len(occupancy.colors) == 0:
        raise ExportError("The map has no occupied voxel to write.")


def _colors(scan_map: Map, by: str) -> NDArray[np.uint8]:
    """(V, 3) colour of each occupied voxel."""
    occupancy = scan_map.occupancy
    if by == "class":
        return class_colors(scan_map.vocabulary)[scan_map.labels()]
    if by == "height":
        return height_colors(occupancy, scan_map.up)
    if by == "probability":
        return ramp(occupancy.probability[occupancy.state == OCCUPIED])
    return occupancy.colors


def _write(occupancy: Occupancy, colors: NDArray[np.uint8], path: Path, form: str) -> None:
    if form == "points":
        points = occupancy.centers(occupancy.occupied_voxels(), occupancy.occupied_edges()).astype(np.float32)
        _write_ply(path, points, colors, None)
    else:
        vertices, quads, rows = exposed_faces(occupancy)
        _write_ply(path, vertices, np.repeat(colors[rows], 4, axis=0), quads)


def _write_ply(
    path: Path, points: NDArray[np.float32], colors: NDArray[np.uint8], quads: NDArray[np.int32] | None
) -> None:
    """Binary little-endian PLY with coloured vertices and, if given, quads."""
    vertex = np.empty(len(points), [("xyz", "<f4", 3), ("rgb", "u1", 3)])
    vertex["xyz"], vertex["rgb"] = points, colors
    header = [
        "ply", "format binary_little_endian 1.0", "comment freeocc3d, metres", f"element vertex {len(points)}",
        *(f"property float {name}" for name in "xyz"), *(f"property uchar {name}" for name in ("red", "green", "blue")),
    ]  # fmt: skip
    if quads is not None:
        header += [f"element face {len(quads)}", "property list uchar int vertex_indices"]
    with path.open("wb") as stream:
        stream.write(("\n".join([*header, "end_header"]) + "\n").encode("ascii"))
        stream.write(vertex.tobytes())
        if quads is not None:
            face = np.empty(len(quads), [("count", "u1"), ("corners", "<i4", 4)])
            face["count"], face["corners"] = 4, quads
            stream.write(face.tobytes())
