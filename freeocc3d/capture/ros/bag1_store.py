"""Storage of ROS 1: a .bag file of format 2.0, with its index. Source: wiki.ros.org/Bags/Format/2.0."""

from __future__ import annotations

import functools
import struct
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..files.file_bytes import Bytes, DamagedFile, FileBytes, HeldBytes
from .message_store import KEPT_CHUNKS, Messages, MessageStore, Place, check_length, decompress, sort_messages

START = b"#ROSBAG V"

_MESSAGE, _CONNECTION = 2, 7  # values of "op"
_USUAL_HEADER = 128  # bytes before a message that are read with its first bytes


class Bag1Store(MessageStore):
    """Messages of a .bag. An index is needed; bags that were not closed have none."""

    ros1 = True

    def __init__(self, path: Path):
        self._file = FileBytes(path)
        self._chunks: list[tuple[int, int, str]] = []
        """Offset, size, compression."""
        self.topics = {}
        self._found: dict[str, list[NDArray[np.int64]]] = {}
        self._read_index(path)
        self._chunk = functools.lru_cache(KEPT_CHUNKS)(self._decompressed)

    def _read_index(self, path: Path) -> None:
        from rosbags.rosbag1 import Reader
        from rosbags.rosbag1.reader import decompressors

        kinds = {id(function): name for name, function in decompressors.items()}
        try:
            with Reader(path) as reader:
                for connection in reader.connections:
                    self.topics[connection.topic] = connection.msgtype
                    entries = np.array(reader.indexes[connection.id], np.int64).reshape(-1, 3)
                    self._found.setdefault(connection.topic, []).append(entries)
                rows = {position: row for row, position in enumerate(reader.chunks)}
                for chunk in reader.chunks.values():
                    self._chunks.append((chunk.datapos, chunk.datasize, kinds[id(chunk.decompressor)]))
        except OSError:
            raise
        except Exception as error:  # rosbags checks little of a damaged file
            raise DamagedFile("its index is missing, damaged or cut off: run rosbag reindex") from error
        positions = np.array(sorted(rows), np.int64)
        order = np.array([rows[position] for position in positions.tolist()], np.int64)
        for entries in (entries for parts in self._found.values() for entries in parts):
            entries[:, 1] = order[np.searchsorted(positions, entries[:, 1])] if len(entries) else entries[:, 1]

    def find(self, topic: str) -> Messages:
        entries = np.concatenate(self._found.get(topic) or [np.zeros((0, 3), np.int64)])
        places = np.column_stack((np.zeros(len(entries), np.int64), entries[:, 1:]))
        return sort_messages(entries[:, 0], places)

    def read(self, place: Place, first: int | None = None) -> bytes:
        _, row, offset = place
        at, size, compression = self._chunks[row]
        if compression == "none":
            return _message(self._file, at + offset, at + size, first)
        chunk = self._chunk(row)
        return _message(chunk, offset, chunk.size, first)

    def _decompressed(self, row: int) -> HeldBytes:
        at, size, compression = self._chunks[row]
        return HeldBytes(decompress(compression, self._file.read(at, check_length(size))))


def _message(source: Bytes, at: int, end: int, first: int | None) -> bytes:
    """The data of the message record at an offset; records of connections may precede it."""
    for _ in range(1000):
        known = source.read(at, min(_USUAL_HEADER + (first or 0), max(end - at, 0)))
        try:
            length = struct.unpack_from("<I", known)[0]
            if 8 + length > len(known):
                known = source.read(at, check_length(8 + length))
            operation, size = _operation(known[4 : 4 + length]), struct.unpack_from("<I", known, 4 + length)[0]
        except struct.error as error:
            raise DamagedFile("it is cut off or damaged: a record reaches beyond its end") from error
        start, at = 8 + length, at + 8 + length
        if operation == _MESSAGE:
            wanted = check_length(size if first is None else min(first, size))
            return known[start : start + wanted] if start + wanted <= len(known) else source.read(at, wanted)
        if operation != _CONNECTION:
            break
        at += size
    raise DamagedFile("its index is damaged: it leads to no message")


def _operation(header: bytes) -> int:
    """The field "op" of a record's header, -1 if there is none."""
    at = 0
    while at + 4 <= len(header):
        size = struct.unpack_from("<I", header, at)[0]
        if header[at + 4 : at + 7] == b"op=" and size == 4:
            return header[at + 7] if at + 7 < len(header) else -1
        at += 4 + size
    return -1
