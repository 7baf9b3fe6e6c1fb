"""glTF binary files of colored meshes. Source: glTF 2.0 specification, Khronos Group."""

from __future__ import annotations

import json
import struct
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .. import __version__

Z_UP_TO_Y_UP = np.array([(1.0, 0, 0, 0), (0, 0, 1, 0), (0, -1, 0, 0), (0, 0, 0, 1)])
"""glTF requires that y points up."""

_FLOAT, _UINT32, _UINT8 = 5126, 5125, 5121
_VERTICES, _INDICES = 34962, 34963


@dataclass(frozen=True)
class MeshNode:
    """A node with a mesh of colored quads.

    positions: (4 Q, 3) float32 meters.  quads: (Q, 4) rows of positions, counter-clockwise from outside.
    colors: (Q, 3) uint8 sRGB of each quad.  T_parent_node: (4, 4) rigid.  extras: plain values for readers.
    """

    name: str
    positions: NDArray[np.float32]
    quads: NDArray[np.integer]
    colors: NDArray[np.uint8]
    T_parent_node: NDArray[np.float64]
    extras: dict[str, Any] = field(default_factory=dict)


def write_glb(path: Path, meshes: Sequence[MeshNode], parent: dict[str, Any] | None = None) -> None:
    """Writes meshes, each a node of the scene, or of one parent node with these properties. Raises OSError."""
    arrays: list[tuple[NDArray[Any], int, dict[str, Any]]] = []
    described: list[dict[str, Any]] = []
    for mesh in meshes:
        positions = mesh.positions.astype("<f4")
        triangles = mesh.quads[:, (0, 1, 2, 0, 2, 3)].astype("<u4")
        colors = np.full((len(positions), 4), 255, np.uint8)  # with alpha: attributes begin at multiples of 4 bytes
        colors[:, :3] = np.repeat(_linear(mesh.colors), 4, axis=0)
        low, high = (bound.tolist() for bound in (positions.min(axis=0), positions.max(axis=0)))
        first = len(arrays)
        arrays += [
            (positions, _VERTICES, {"componentType": _FLOAT, "count": len(positions), "type": "VEC3", "min": low,
                                    "max": high}),
            (colors, _VERTICES, {"componentType": _UINT8, "normalized": True, "count": len(colors), "type": "VEC4"}),
            (triangles, _INDICES, {"componentType": _UINT32, "count": triangles.size, "type": "SCALAR"}),
        ]  # fmt: skip
        attributes = {"POSITION": first, "COLOR_0": first + 1}
        described.append({"primitives": [{"attributes": attributes, "indices": first + 2, "material": 0}]})
    views, start = [], 0
    for array, target, _ in arrays:
        views.append({"buffer": 0, "byteOffset": start, "byteLength": array.nbytes, "target": target})
        start += array.nbytes
    nodes = [
        {"name": mesh.name, "mesh": k, "matrix": mesh.T_parent_node.T.ravel().tolist(), "extras": mesh.extras}
        for k, mesh in enumerate(meshes)
    ]
    roots = list(range(len(nodes)))
    if parent is not None:
        nodes.append({**parent, "children": roots})
        roots = [len(nodes) - 1]
    document = {
        "asset": {"version": "2.0", "generator": f"freeocc3d {__version__}"},
        "scene": 0,
        "scenes": [{"nodes": roots}],
        "nodes": nodes,
        "meshes": described,
        "materials": [{"pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 1.0}}],
        "buffers": [{"byteLength": start}],
        "bufferViews": views,
        "accessors": [{"bufferView": k, **accessor} for k, (_, _, accessor) in enumerate(arrays)],
    }
    text = json.dumps(document).encode("utf-8")
    text += b" " * (-len(text) % 4)
    body = b"".join(array.tobytes() for array, _, _ in arrays)
    chunks = ((b"JSON", text), (b"BIN\0", body))
    with path.open("wb") as stream:
        stream.write(struct.pack("<4sII", b"glTF", 2, 12 + sum(8 + len(data) for _, data in chunks)))
        for kind, data in chunks:
            stream.write(struct.pack("<I4s", len(data), kind) + data)


def _linear(colors: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Returns sRGB screen colors as linear light, which renderers compute with and glTF's vertex colors hold."""
    c = np.arange(256) / 255.0
    table = np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)
    return np.rint(255 * table).astype(np.uint8)[colors]
