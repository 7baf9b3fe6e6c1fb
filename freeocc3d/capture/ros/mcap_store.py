"""Storage of ROS 2 (and 1): an .mcap file. Its index is used where it has one; else the file is passed once.
Source: mcap.dev/spec."""

from __future__ import annotations

import functools
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..files.file_bytes import Bytes, DamagedFile, FileBytes, HeldBytes
from .message_store import KEPT_CHUNKS, Messages, MessageStore, Place, check_length, decompress, sort_messages

START = b"\x89MCAP0\r\n"

_HEADER, _FOOTER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _INDEX, _CHUNK_INDEX, _DATA_END = 1, 2, 3, 4, 5, 6, 7, 8, 15
_PREFIX = 9  # bytes of a record before its content: one of its kind, eight of its length
_MESSAGE_HEAD = 22
_MOST_RECORDS = 10_000_000
"""Most records that are visited one by one: those of hours."""
_TAIL = _PREFIX + 20 + len(START)


@dataclass(frozen=True)
class _Chunk:
    """A chunk record at ``start``. indexes: channel -> offset of its message index; None = the file states none."""

    start: int
    indexes: dict[int, int] | None


class McapStore(MessageStore):
    """Messages of an .mcap with the encodings cdr or ros1."""

    def __init__(self, path: Path):
        self._file = FileBytes(path)
        self._schemas: dict[int, str] = {0: ""}
        self._channels: dict[int, tuple[str, str]] = {}
        """Number -> topic, type."""
        self._encodings: set[str] = set()
        self._chunks: list[_Chunk] = []
        self._headers: dict[int, tuple[int, int, str]] = {}
        self._loaded = functools.lru_cache(KEPT_CHUNKS)(self._decompressed)
        try:
            self._passed = None if self._read_summary() else self._pass_through()
        except (struct.error, UnicodeDecodeError) as error:
            raise DamagedFile("it is damaged: run mcap recover") from error
        self.ros1 = "ros1" in self._encodings
        self.topics = {topic: _ros2_name(kind) for topic, kind in self._channels.values()}

    def find(self, topic: str) -> Messages:
        numbers = [number for number, (name, _) in self._channels.items() if name == topic]
        if self._passed is not None:
            every = [entry for number in numbers for entry in self._passed.get(number, ())]
            table = np.array(every, np.int64).reshape(-1, 3)
        else:
            parts = [
                self._indexed(row, chunk.indexes[number])
                for row, chunk in enumerate(self._chunks)
                for number in numbers
                if chunk.indexes and number in chunk.indexes
            ]
            table = np.concatenate(parts or [np.zeros((0, 3), np.int64)])
        return sort_messages(table[:, 0], np.column_stack((np.zeros(len(table), np.int64), table[:, 1:])))

    def read(self, place: Place, first: int | None = None) -> bytes:
        _, row, at = place
        try:
            source, base = (self._file, 0) if row < 0 else self._content(row)
            start = source.read(base + at, _PREFIX)
            kind, size = struct.unpack("<BQ", start)
        except (struct.error, UnicodeDecodeError) as error:
            raise DamagedFile("it is damaged: run mcap recover") from error
        if kind != _MESSAGE or size < _MESSAGE_HEAD:
            raise DamagedFile("its index is damaged: it leads to no message")
        wanted = check_length(size - _MESSAGE_HEAD if first is None else min(first, size - _MESSAGE_HEAD))
        return source.read(base + at + _PREFIX + _MESSAGE_HEAD, wanted)

    def _content(self, row: int) -> tuple[Bytes, int]:
        """The bytes that hold a chunk's records, and the offset of the first record. Plain ones stay in the file."""
        at, size, compression = self._chunk_header(self._chunks[row].start)
        return (self._file, at) if not compression or not size else (self._loaded(row), 0)

    def _chunk_header(self, start: int) -> tuple[int, int, str]:
        """Offset and size of a chunk's records, and their compression."""
        if start in self._headers:
            return self._headers[start]
        size = struct.unpack("<Q", self._file.read(start + 1, 8))[0]
        head = _Fields(self._file.read(start + _PREFIX, min(size, 256)), 28)
        compression = head.text()
        stored = head.number("<Q")
        self._headers[start] = start + _PREFIX + head.at, check_length(stored), compression
        return self._headers[start]

    def _decompressed(self, row: int) -> HeldBytes:
        at, size, compression = self._chunk_header(self._chunks[row].start)
        return HeldBytes(decompress(compression, self._file.read(at, size)))

    def _indexed(self, row: int, at: int) -> NDArray[np.int64]:
        """(N, 3) time, chunk, offset of the messages that a message index lists."""
        kind, _, _, length = struct.unpack("<BQHI", self._file.read(at, _PREFIX + 6))
        if kind != _INDEX:
            raise DamagedFile("its index is damaged: run mcap recover")
        data = self._file.read(at + _PREFIX + 6, check_length(length // 16 * 16))
        table = np.frombuffer(data, "<i8").reshape(-1, 2)
        return np.column_stack((table[:, 0], np.full(len(table), row), table[:, 1])).astype(np.int64)

    def _read_summary(self) -> bool:
        """Read the channels and chunks that the end of the file lists; false if it does not list all."""
        if self._file.size < len(START) + _TAIL or self._file.read(self._file.size - len(START), len(START)) != START:
            raise DamagedFile("it is cut off, for its end is missing: run mcap recover")
        end = self._file.size - _TAIL
        kind, _, start = struct.unpack_from("<BQQ", self._file.read(end, _TAIL))
        if kind != _FOOTER or (start and not len(START) <= start <= end):
            raise DamagedFile("its end is damaged: run mcap recover")
        if not start:
            return False
        check_length(end - start)
        for kind, at, size in _records(self._file, start, end):
            self._note(kind, self._file, at, size)
            if kind == _CHUNK_INDEX:
                fields = _Fields(self._file.read(at, size), 16)
                chunk, _ = fields.number("<Q"), fields.number("<Q")
                pairs = struct.iter_unpack("<HQ", fields.part())
                self._chunks.append(_Chunk(chunk, dict(pairs) or None))
        return bool(self._channels and self._chunks) and all(chunk.indexes for chunk in self._chunks)

    def _pass_through(self) -> dict[int, list[tuple[int, int, int]]]:
        """Channel -> (time, chunk, offset) of all messages, from the file itself."""
        self._chunks = []
        found: dict[int, list[tuple[int, int, int]]] = {}

        def note(kind: int, row: int, source: Bytes, at: int, size: int) -> None:
            self._note(kind, source, at, size)
            if kind == _MESSAGE:
                number, _, time = struct.unpack("<HIQ", source.read(at, 14))
                found.setdefault(number, []).append((time, row, at - _PREFIX))

        for kind, at, size in _records(self._file, len(START), self._file.size - len(START)):
            if kind == _DATA_END:
                break
            note(kind, -1, self._file, at, size)
            if kind == _CHUNK:
                self._chunks.append(_Chunk(at - _PREFIX, None))
                row = len(self._chunks) - 1
                source, base = self._content(row)
                end = base + (self._chunk_header(at - _PREFIX)[1] if source is self._file else source.size)
                for inner, inner_at, inner_size in _records(source, base, end):
                    note(inner, row, _Shifted(source, base), inner_at - base, inner_size)
        return found

    def _note(self, kind: int, source: Bytes, at: int, size: int) -> None:
        """Note a schema or channel."""
        if kind == _SCHEMA:
            fields = _Fields(source.read(at, check_length(size)))
            number = fields.number("<H")
            self._schemas[number] = fields.text()
        elif kind == _CHANNEL:
            fields = _Fields(source.read(at, check_length(size)))
            number, schema = fields.number("<H"), fields.number("<H")
            topic, encoding = fields.text(), fields.text()
            if encoding in ("cdr", "ros1"):
                self._channels[number] = topic, self._schemas.get(schema, "")
                self._encodings.add(encoding)


class _Shifted:
    """Bytes from an offset on."""

    def __init__(self, source: Bytes, base: int):
        self._source, self._base, self.size = source, base, source.size - base

    def read(self, offset: int, size: int) -> bytes:
        """Exactly so many bytes. Raises DamagedFile if there are fewer."""
        return self._source.read(self._base + offset, size)


class _Fields:
    """Reads the fields of a record one after the other. Raises struct.error at its end."""

    def __init__(self, data: bytes, at: int = 0):
        self._data, self.at = data, at

    def number(self, form: str) -> int:
        value = struct.unpack_from(form, self._data, self.at)[0]
        self.at += struct.calcsize(form)
        return int(value)

    def part(self) -> bytes:
        size = self.number("<I")
        self.at += size
        if self.at > len(self._data):
            raise struct.error("the record ends before its field")
        return self._data[self.at - size : self.at]

    def text(self) -> str:
        return self.part().decode()


def _records(source: Bytes, at: int, end: int) -> Iterator[tuple[int, int, int]]:
    """Kind, offset of the content and its size, of the records between two offsets. Raises DamagedFile."""
    for _ in range(_MOST_RECORDS):
        if at + _PREFIX > end:
            return
        kind, size = struct.unpack("<BQ", source.read(at, _PREFIX))
        at += _PREFIX
        if at + size > end:
            raise DamagedFile("it is cut off or damaged: run mcap recover")
        yield kind, at, size
        at += size
    raise DamagedFile(f"it has more than {_MOST_RECORDS:,} records without an index: run mcap recover")


def _ros2_name(kind: str) -> str:
    """sensor_msgs/Image, as ROS 1 says, as sensor_msgs/msg/Image."""
    package, _, name = kind.partition("/")
    return f"{package}/msg/{name}" if name and "/" not in name else kind
