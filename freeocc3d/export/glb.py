"""glTF binary: the occupied voxels as a colored mesh for Blender, Unity, Unreal and web viewers.

One mesh holds the faces between occupied and other voxels, in the frame's coordinates. Its node turns it so that up is
+y, as glTF requires. The node's `extras` name the frame. Source: glTF 2.0 specification, Khronos Group.
"""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .. import __version__
from ..core.errors import ExportError
from ..core.transforms import invert
from ..occupancy.surface_faces import find_exposed_faces
from ..query.scan_map import Map
from .export_frames import PlacedVoxels, VoxelOptions, place_voxels
from .ply import ColorBy, choose_colors

REQUIRES: tuple[str, ...] = ()
ENDINGS = (".glb",)

_FLOAT, _UINT32, _UINT8 = 5126, 5125, 5121
_VERTICES, _INDICES = 34962, 34963
_Z_UP_TO_Y_UP = np.array([(1.0, 0, 0, 0), (0, 0, 1, 0), (0, -1, 0, 0), (0, 0, 0, 1)])


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
    triangles = quads[:, (0, 1, 2, 0, 2, 3)].astype(np.uint32)
    colors = np.full((len(positions), 4), 255, np.uint8)  # with alpha, because attributes begin at multiples of 4 bytes
    colors[:, :3] = np.repeat(_linear(choose_colors(scan_map, there, options.color))[rows], 4, axis=0)
    turned = np.eye(4)
    turned[:3, :3] = (_Z_UP_TO_Y_UP @ scan_map.T_gravity_map @ invert(there.T_frame_map))[:3, :3]
    to_y_up = _Z_UP_TO_Y_UP if there.is_upright else turned
    body = b"".join(part.tobytes() for part in (positions.astype("<f4"), colors, triangles.astype("<u4")))
    described = json.dumps(_described(there, positions, colors, triangles, to_y_up, len(body))).encode("utf-8")
    described += b" " * (-len(described) % 4)
    chunks = ((b"JSON", described), (b"BIN\0", body))
    with path.open("wb") as stream:
        stream.write(struct.pack("<4sII", b"glTF", 2, 12 + sum(8 + len(data) for _, data in chunks)))
        for kind, data in chunks:
            stream.write(struct.pack("<I4s", len(data), kind) + data)


def _described(
    there: PlacedVoxels,
    positions: NDArray[np.float32],
    colors: NDArray[np.uint8],
    triangles: NDArray[np.uint32],
    to_y_up: NDArray[np.float64],
    size: int,
) -> dict[str, Any]:
    views, start = [], 0
    for array, target in ((positions, _VERTICES), (colors, _VERTICES), (triangles, _INDICES)):
        views.append({"buffer": 0, "byteOffset": start, "byteLength": array.nbytes, "target": target})
        start += array.nbytes
    low, high = (bound.tolist() for bound in (positions.min(axis=0), positions.max(axis=0)))
    return {
        "asset": {"version": "2.0", "generator": f"freeocc3d {__version__}"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"name": "occupied", "mesh": 0, "matrix": to_y_up.T.ravel().tolist(), "extras": there.described()}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "COLOR_0": 1}, "indices": 2, "material": 0}]}],
        "materials": [{"pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 1.0}}],
        "buffers": [{"byteLength": size}],
        "bufferViews": views,
        "accessors": [
            {"bufferView": 0, "componentType": _FLOAT, "count": len(positions), "type": "VEC3", "min": low,
             "max": high},
            {"bufferView": 1, "componentType": _UINT8, "normalized": True, "count": len(colors), "type": "VEC4"},
            {"bufferView": 2, "componentType": _UINT32, "count": triangles.size, "type": "SCALAR"},
        ],
    }  # fmt: skip


def _linear(colors: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Returns sRGB screen colors as linear light, which renderers compute with and glTF's vertex colors hold."""
    c = np.arange(256) / 255.0
    table = np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)
    return np.rint(255 * table).astype(np.uint8)[colors]
