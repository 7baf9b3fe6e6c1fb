"""A plain reader of OpenVDB files with one float grid without tiles, for machines that lack OpenVDB.

Source: the layout that OpenVDB's io/Archive.cc and tree/*.h read, file format 224, mask compression without zip.
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np


class _Stream:
    def __init__(self, data: bytes) -> None:
        self.data, self.at = data, 0

    def read(self, layout: str) -> tuple:
        values = struct.unpack_from(f"<{layout}", self.data, self.at)
        self.at += struct.calcsize(f"<{layout}")
        return values

    def text(self) -> str:
        (length,) = self.read("I")
        return self.read(f"{length}s")[0].decode()

    def metadata(self) -> dict[str, str]:
        (count,) = self.read("I")
        found = {}
        for _ in range(count):
            name, kind = self.text(), self.text()
            assert kind == "string"
            found[name] = self.text()
        return found

    def bits(self, edge: int) -> np.ndarray:
        """The (n, 3) places of the set bits of a node's mask."""
        packed = np.frombuffer(self.data, np.uint8, edge**3 // 8, self.at)
        self.at += edge**3 // 8
        found = np.flatnonzero(np.unpackbits(packed, bitorder="little"))
        return np.stack((found // edge**2, found // edge % edge, found % edge), axis=1)


def read_vdb_plainly(path: Path, indices: Any) -> dict[str, Any]:
    """What ``exported_maps.read_vdb`` returns."""
    stream = _Stream(path.read_bytes())
    magic, version, _, _, has_offsets, _ = stream.read("qIII?36s")
    assert (magic, version, has_offsets) == (0x56444220, 224, True)
    assert stream.metadata() == {}
    assert stream.read("i") == (1,)
    name, kind, parent = stream.text(), stream.text(), stream.text()
    assert (kind, parent) == ("Tree_float_5_4_3", "")
    start, buffers, end = stream.read("3q")
    assert stream.at == start
    assert stream.read("I") == (2,)  # only active values are stored
    metadata = stream.metadata()
    assert stream.text() == "UniformScaleTranslateMap"
    translation, scale, size, inverse, squared, twice = np.array(stream.read("18d")).reshape(6, 3)
    for found, wanted in ((size, scale), (inverse, 1 / scale), (squared, 1 / scale**2), (twice, 0.5 / scale)):
        np.testing.assert_allclose(found, wanted)
    background, leaves = _topology(stream)
    assert stream.at == buffers
    values: dict[tuple[int, ...], float] = {}
    for corner, active in leaves:
        np.testing.assert_array_equal(stream.bits(8), active)
        assert stream.read("B") == (0,)
        numbers = stream.read(f"{len(active)}f")
        values |= dict(zip(map(tuple, (corner + active).tolist()), numbers, strict=True))
    assert stream.at == end == len(stream.data)
    return {
        "name": name,
        "background": background,
        "active": len(values),
        "world": [(translation + scale * index).tolist() for index in ((0, 0, 0), (3, -5, 200))],
        "metadata": metadata,
        "values": [[values.get(tuple(at), background), tuple(at) in values] for at in np.asarray(indices).tolist()],
    }


def _topology(stream: _Stream) -> tuple[float, list[tuple[np.ndarray, np.ndarray]]]:
    """The background, and each leaf's corner and the places of its active voxels, in the file's order."""
    one, background, tiles, children = stream.read("ifII")
    assert (one, tiles) == (1, 0)
    leaves = []
    for _ in range(children):
        root = np.array(stream.read("3i"))
        assert not (root % 4096).any()
        for node in _children(stream, 32):
            for leaf in _children(stream, 16):
                leaves.append((root + 128 * node + 8 * leaf, stream.bits(8)))
    return background, leaves


def _children(stream: _Stream, edge: int) -> np.ndarray:
    children, tiles = stream.bits(edge), stream.bits(edge)
    assert not len(tiles)
    assert stream.read("B") == (0,)
    return children
