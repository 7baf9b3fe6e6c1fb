"""Writes a float grid as OpenVDB does: one 5-4-3 tree; its leaves are the map's blocks of 8 x 8 x 8 voxels.

Source: the reader and writer of OpenVDB 10 (io/Archive, tree/RootNode, InternalNode, LeafNode), file format 224.
"""

from __future__ import annotations

import itertools
import struct
import uuid
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..core.types import BLOCK

_MAGIC, _FILE_VERSION, _LIBRARY_VERSION = 0x56444220, 224, (10, 0)
_ACTIVE_VALUES_ONLY = 2  # a compression flag: inactive values equal the background and are left out
_INACTIVE_ARE_BACKGROUND = 0
_LEAVES = 16  # along an edge of a node that holds leaves
_NODES = 32  # along an edge of a node that holds such nodes
_NO_TILES = bytes(_NODES**3 // 8)


def write_vdb(
    path: Path,
    name: str,
    keys: NDArray[np.int32],
    values: NDArray[np.float32],
    active: NDArray[np.bool_],
    voxel_size: float,
    center: NDArray[np.float64],
    metadata: Mapping[str, str],
) -> None:
    """Writes one grid with background 0. Raises OSError.

    keys: (B, 3) indices of one or more blocks.  values, active: (B, 512), with local index (i * 8 + j) * 8 + k; a voxel
    that is not active has no value.  center: (3,) center of voxel (0, 0, 0), which is OpenVDB's index 0.
    """
    node = keys.astype(np.int64) // _LEAVES
    root = node // _NODES
    leaf_at = _offsets(keys - node * _LEAVES, _LEAVES)
    node_at = _offsets(node - root * _NODES, _NODES)
    order = np.lexsort((leaf_at, node_at, *root.T[::-1]))
    root, node_at, leaf_at = root[order], node_at[order], leaf_at[order]
    masks = np.packbits(active[order], axis=1, bitorder="little")
    under_root = _runs(root)
    topology = [struct.pack("<if", 1, 0.0), struct.pack("<II", 0, len(under_root))]  # buffers, background; tiles
    for child in under_root:
        topology.append(struct.pack("<3i", *(root[child.start] * _NODES * _LEAVES * BLOCK).tolist()))
        topology += [_mask(node_at[child], _NODES), _NO_TILES, bytes([_INACTIVE_ARE_BACKGROUND])]
        for run in _runs(node_at[child, None]):
            leaves = slice(child.start + run.start, child.start + run.stop)
            topology += [_mask(leaf_at[leaves], _LEAVES), bytes(_LEAVES**3 // 8), bytes([_INACTIVE_ARE_BACKGROUND])]
            topology.append(masks[leaves].tobytes())

    with path.open("wb") as stream:
        stream.write(struct.pack("<qIII?", _MAGIC, _FILE_VERSION, *_LIBRARY_VERSION, True))
        stream.write(str(uuid.uuid4()).encode("ascii"))
        stream.write(_metadata({}) + struct.pack("<i", 1))
        stream.write(_text(name) + _text("Tree_float_5_4_3") + _text(""))
        here = stream.tell() + 3 * 8
        described = struct.pack("<I", _ACTIVE_VALUES_ONLY) + _metadata({"name": name, **metadata})
        body = described + _transform(voxel_size, center) + b"".join(topology)
        buffers = _buffers(masks, values[order], active[order])
        stream.write(struct.pack("<3q", here, here + len(body), here + len(body) + len(buffers)))
        stream.write(body)
        stream.write(buffers)


def _buffers(masks: NDArray[np.uint8], values: NDArray[np.float32], active: NDArray[np.bool_]) -> bytes:
    """Returns, for each leaf, its mask, a byte about its inactive values, and its active values."""
    head = np.concatenate((masks, np.full((len(masks), 1), _INACTIVE_ARE_BACKGROUND, np.uint8)), axis=1)
    records = np.concatenate((head, np.ascontiguousarray(values, "<f4").view(np.uint8)), axis=1)
    kept = np.concatenate((np.ones(head.shape, bool), np.repeat(active, 4, axis=1)), axis=1)
    return records[kept].tobytes()


def _transform(voxel_size: float, center: NDArray[np.float64]) -> bytes:
    size = np.full(3, voxel_size)
    rows = np.asarray(center, np.float64), size, size, 1 / size, 1 / size**2, 0.5 / size
    return _text("UniformScaleTranslateMap") + np.concatenate(rows).astype("<f8").tobytes()


def _metadata(values: Mapping[str, str]) -> bytes:
    entries = (_text(name) + _text("string") + _text(value) for name, value in values.items())
    return struct.pack("<I", len(values)) + b"".join(entries)


def _text(value: str) -> bytes:
    data = value.encode("utf-8")
    return struct.pack("<I", len(data)) + data


def _offsets(index: NDArray[np.int64], edge: int) -> NDArray[np.int64]:
    return (index[:, 0] * edge + index[:, 1]) * edge + index[:, 2]


def _mask(offsets: NDArray[np.int64], edge: int) -> bytes:
    bits = np.zeros(edge**3, bool)
    bits[offsets] = True
    return np.packbits(bits, bitorder="little").tobytes()


def _runs(rows: NDArray[np.int64]) -> list[slice]:
    """Returns the runs of equal rows."""
    starts = np.flatnonzero((np.diff(rows, axis=0) != 0).any(axis=1)) + 1
    bounds = [0, *starts.tolist(), len(rows)]
    return [slice(first, last) for first, last in itertools.pairwise(bounds)]
