"""glTF binary: the occupied voxels as a colored mesh for Blender, Unity, Unreal and web viewers.

One mesh holds the faces between occupied and other voxels, in the frame's coordinates. Its node turns it so that up is
+y, as glTF requires. The node's `extras` name the frame. Source: glTF 2.0 specification, Khronos Group.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..core.errors import ExportError
from ..core.transforms import invert
from ..occupancy.surface_faces import find_exposed_faces
from ..query.scan_map import Map
from .export_frames import VoxelOptions, place_voxels
from .gltf_files import Z_UP_TO_Y_UP, MeshNode, write_glb
from .ply import ColorBy, choose_colors

REQUIRES: tuple[str, ...] = ()
ENDINGS = (".glb",)


class Options(VoxelOptions, frozen=True):
    """Frame and color."""

    color: ColorBy = "rgb"
    """"rgb" for the surface's own color, "class", "height" or "probability", as in `ply`."""


def write(scan_map: Map, path: Path, options: Options) -> None:
    """Writes the mesh. Raises ExportError for a map without occupied voxels."""
    there = place_voxels(scan_map, options.frame, box=options.box)
    if not len(there.occupancy.colors):
        raise ExportError("The map has no occupied voxels to write.")
    positions, quads, rows = find_exposed_faces(there.occupancy)
    turned = np.eye(4)
    turned[:3, :3] = (Z_UP_TO_Y_UP @ scan_map.T_gravity_map @ invert(there.T_frame_map))[:3, :3]
    to_y_up = Z_UP_TO_Y_UP if there.is_upright else turned
    colors = choose_colors(scan_map, there, options.color)[rows]
    write_glb(path, [MeshNode("occupied", positions, quads, colors, to_y_up, there.described())])
