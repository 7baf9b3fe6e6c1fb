"""OctoMap: an octree of free and occupied space, `.bt` (free or occupied), `.ot` (with log-odds, and colors).

MoveIt, OMPL's examples, octovis and all programs that link OctoMap read it. The tree's resolution is the map's smallest
voxel; larger voxels become leaves of lower depth. NAME.json next to the file holds the frame.
Source: the file formats of A. Hornung et al., OctoMap, Autonomous Robots 2013, as its library 1.9 writes them.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.errors import ConfigError, ExportError
from ..core.types import FREE, OCCUPIED, Occupancy
from ..query.scan_map import Map
from .export_frames import PlacedVoxels, VoxelOptions, place_voxels, write_description
from .octree import KEY_ORIGIN, Leaves, Octree, build_octree

REQUIRES: tuple[str, ...] = ()
ENDINGS = (".bt", ".ot")

_CLAMP = np.log(0.1192 / 0.8808), np.log(0.971 / 0.029)
"""OctoMap's default range of log-odds."""
_LEAST = 0.05  # log-odds: an occupied voxel has more, a free voxel less than the negative
_UNSET = 255  # in all three channels: OctoMap's color of a node without color


class Options(VoxelOptions, frozen=True):
    """Frame and colors. A name ending in .bt gives the binary form, one in .ot the full form."""

    color: bool = False
    """Write a ColorOcTree (.ot only): occupied leaves have the surface's color."""


def write(scan_map: Map, path: Path, options: Options) -> None:
    """Writes the tree. Raises ConfigError for colors in a .bt; ExportError if nothing is known, or if the map is too
    large for a tree of its resolution."""
    binary = path.suffix.lower() == ".bt"
    if binary and options.color:
        raise ConfigError("A .bt holds no colors: name the file .ot.")
    there, tree = make_tree(scan_map, options, log_odds=not binary, color=options.color)
    with path.open("wb") as stream:
        kind = "OcTree binary" if binary else "OcTree"
        name = "ColorOcTree" if options.color else "OcTree"
        header = f"# Octomap {kind} file\n# freeocc3d, {there.frame} frame, {there.unit}\nid {name}\nsize {len(tree)}\n"
        stream.write(f"{header}res {there.occupancy.finest:.12g}\ndata\n".encode("ascii"))
        stream.write(encode_binary(tree) if binary else _full_nodes(tree, options.color))
    write_description(path, there.described())


def make_tree(
    scan_map: Map, options: VoxelOptions, log_odds: bool = False, color: bool = False
) -> tuple[PlacedVoxels, Octree]:
    """Returns the map's voxels on the lattice of a tree, and the tree. log_odds, color: see ``collect_leaves``."""
    there = place_voxels(scan_map, options.frame, origin=(0.0, 0.0, 0.0), box=options.box)
    return there, build_octree(collect_leaves(there.occupancy, log_odds, color))


def collect_leaves(occupancy: Occupancy, log_odds: bool, color: bool) -> list[Leaves]:
    """Returns the known voxels by size, the smallest first. log_odds: take values from the probabilities, with each
    voxel on its side of 0; else all occupied voxels have one value and all free voxels another. Raises ExportError as
    ``write`` does."""
    shift = np.rint(occupancy.origin / occupancy.finest).astype(np.int64)
    corners = np.concatenate([occupancy.voxels(state) for state in (OCCUPIED, FREE)]) + shift
    edges = np.concatenate([occupancy.edges(state) for state in (OCCUPIED, FREE)])
    if not len(corners):
        raise ExportError("The map has no known voxels, free or occupied, so there is no tree to write.")
    if corners.min() < -KEY_ORIGIN or (corners + edges[:, None]).max() > KEY_ORIGIN:
        reach = KEY_ORIGIN * occupancy.finest
        raise ExportError(
            f"The map reaches farther than {reach:.0f} m from its origin, the limit of an octree of "
            f"{occupancy.finest:g} m voxels: export a part of it with --set box=…, or reconstruct it with larger "
            "voxels."
        )
    states = np.repeat((OCCUPIED, FREE), [np.count_nonzero(occupancy.state == state) for state in (OCCUPIED, FREE)])
    values = np.where(states == OCCUPIED, 1.0, -1.0).astype(np.float32)
    if log_odds:
        p = np.concatenate([occupancy.probability[occupancy.state == state] for state in (OCCUPIED, FREE)])
        values = _log_odds(p, states == OCCUPIED)
    colors = np.full((len(corners), 3), _UNSET, np.uint8)
    if color:
        colors[: len(occupancy.colors)] = np.minimum(occupancy.colors, _UNSET - 1)
    sizes = [edges == 1 << height for height in range(occupancy.deepest + 1)]
    return [Leaves(corners[own].astype(np.int32), values[own], colors[own]) for own in sizes]


def _log_odds(probability: NDArray[np.float32], occupied: NDArray[np.bool_]) -> NDArray[np.float32]:
    p = np.clip(probability, 1e-6, 1 - 1e-6)
    odds = np.clip(np.log(p / (1 - p)), *_CLAMP)
    return np.where(occupied, np.maximum(odds, _LEAST), np.minimum(odds, -_LEAST)).astype(np.float32)


def encode_binary(tree: Octree) -> bytes:
    """Returns the nodes of a .bt: two bytes for each node with children, two bits per child. Leaves appear only in
    their parents."""
    return tree.kinds[tree.children > 0].astype("<u2").tobytes()


def _full_nodes(tree: Octree, color: bool) -> bytes:
    """Returns, for each node, its log-odds, its color if any, and which children it has."""
    fields: list[tuple[Any, ...]] = [("value", "<f4"), *([("color", "u1", 3)] if color else []), ("children", "u1")]
    nodes = np.empty(len(tree), fields)
    nodes["value"], nodes["children"] = tree.values, tree.children
    if color:
        nodes["color"] = tree.colors
    return nodes.tobytes()
