"""Looks into an ONNX file before onnxruntime does: in which other files it keeps weights, and how large the tensors are
that it makes from nothing.

Source: onnx.proto3 of the ONNX format, and the wire format of protocol buffers (protobuf.dev/programming-guides).
Numbers below are those of the fields.
"""

from __future__ import annotations

import math
import mmap
from collections.abc import Iterator
from pathlib import Path

from .errors import ModelError
from .regular_files import open_regular

_DEEPEST = 100  # as protobuf
_MOST_MADE = 1 << 28
"""Numbers in the largest tensor that a network may make without an input."""
_MAKERS = {b"ConstantOfShape": 0, b"Expand": 1, b"Tile": 1}
"""Kind of node -> which of its inputs states the size of its output."""
_EXTERNAL = 1

_MESSAGES: dict[str, dict[int, str]] = {
    "model": {7: "graph", 25: "graph"},
    "graph": {1: "node", 5: "tensor", 7: "node", 15: "sparse"},
    "node": {5: "attribute"},
    "attribute": {5: "tensor", 6: "graph", 10: "tensor", 11: "graph", 22: "sparse", 23: "sparse"},
    "sparse": {1: "tensor", 2: "tensor"},
}
"""Kind of message -> the fields that hold further messages. A function (25) has its nodes in another field (7) than a
graph."""


def find_external_files(path: Path) -> list[str]:
    """The names of the files in which an ONNX file keeps weights, as it states them. Raises OSError; ModelError if it
    is not ONNX, or makes tensors that fill the memory."""
    with open_regular(path) as stream:
        if stream.seek(0, 2) == 0:
            return []
        with mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as data:
            found = _Contents(data)
            try:
                found.read("model", 0, len(data), 0)
            except (IndexError, ValueError) as error:
                raise ModelError(f"{path} is not an ONNX network that can be read.") from error
    if (made := found.largest_made()) > _MOST_MADE:
        raise ModelError(f"{path} makes a tensor of {made:,} numbers, larger than any network here needs.")
    return list(dict.fromkeys(found.external))


class _Contents:
    """What matters of the messages in a file. external: locations of weights."""

    def __init__(self, data: mmap.mmap):
        self._data = data
        self.external: list[str] = []
        self._shapes: dict[bytes, list[int]] = {}
        self._made_of: list[bytes] = []

    def largest_made(self) -> int:
        """The size of the largest tensor that a node makes of a constant shape."""
        shapes = [self._shapes[name] for name in self._made_of if name in self._shapes]
        return max((math.prod(shape) for shape in shapes if min(shape, default=0) > 0), default=0)

    def read(self, kind: str, at: int, end: int, depth: int) -> None:
        if depth > _DEEPEST:
            raise ValueError
        if kind == "tensor":
            self._read_tensor(at, end, b"")
            return
        parts: dict[int, list[bytes]] = {}
        for field, start, stop in self._fields(at, end):
            if inner := _MESSAGES[kind].get(field):
                self.read(inner, start, stop, depth + 1)
            elif kind == "node" and field in (1, 2, 4):
                parts.setdefault(field, []).append(self._data[start:stop])
        if kind == "node":
            self._read_node(at, end, parts)

    def _read_node(self, at: int, end: int, parts: dict[int, list[bytes]]) -> None:
        kind, inputs = (parts.get(4) or [b""])[0], parts.get(1, [])
        place = _MAKERS.get(kind)
        if place is not None and place < len(inputs):
            self._made_of.append(inputs[place])
        if kind == b"Constant" and parts.get(2):
            for field, start, stop in self._fields(at, end):
                for inner, first, last in self._fields(start, stop) if field == 5 else ():
                    if inner == 5:
                        self._read_tensor(first, last, parts[2][0])

    def _read_tensor(self, at: int, end: int, name: bytes) -> None:
        numbers: list[int] = []
        external: list[tuple[int, int]] = []
        location = kind = 0
        for field, start, stop in self._fields(at, end):
            if field == 2:
                kind = self._varint(start)[0]
            elif field == 8 and not name:
                name = self._data[start:stop]
            elif field == 14:
                location = self._varint(start)[0]
            elif field == 13:
                external.append((start, stop))
            elif field in (7, 9) and stop - start <= 64:  # numbers of 64 bits: as such, or as raw bytes
                numbers += self._numbers(field, start, stop)
        if kind == 7:
            self._shapes[name] = numbers
        if location == _EXTERNAL or external:
            pairs = [{f: self._data[a:b] for f, a, b in self._fields(*span)} for span in external]
            stated = [pair.get(2, b"") for pair in pairs if pair.get(1) == b"location"]
            self.external += [text.decode("utf-8", "replace") for text in stated or [b""]]

    def _numbers(self, field: int, start: int, stop: int) -> list[int]:
        if field == 9:
            data = self._data[start:stop]
            return [int.from_bytes(data[k : k + 8], "little", signed=True) for k in range(0, len(data) - 7, 8)]
        found = []
        while start < stop:
            value, start = self._varint(start)
            found.append(value - (1 << 64) if value >> 63 else value)
        return found

    def _fields(self, at: int, end: int) -> Iterator[tuple[int, int, int]]:
        """Number, start and end of each field of a message. Raises ValueError or IndexError for other bytes."""
        if end > len(self._data):
            raise ValueError
        while at < end:
            tag, at = self._varint(at)
            wire = tag & 7
            start = at
            if wire == 0:
                _, at = self._varint(at)
            elif wire == 2:
                length, start = self._varint(at)
                at = start + length
            elif wire in (1, 5):
                at += 8 if wire == 1 else 4
            else:
                raise ValueError
            if at > end:
                raise ValueError
            yield tag >> 3, start, at

    def _varint(self, at: int) -> tuple[int, int]:
        value = shift = 0
        while True:
            byte = self._data[at]
            value |= (byte & 0x7F) << shift
            at += 1
            if byte < 0x80:
                return value, at
            shift += 7
            if shift > 63:
                raise ValueError
