"""The contract of a bag's storage: where the messages of a topic lie, and their bytes. Memory is bounded: a message is
read when it is asked for, and a few decompressed chunks are kept."""

from __future__ import annotations

import bz2
import functools
import importlib
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..files.file_bytes import DamagedFile

MOST_BYTES = 512 << 20
"""Largest message, and largest chunk after decompression."""

KEPT_CHUNKS = 3
"""Decompressed chunks that are kept: color and depth of one time may lie in neighboring ones."""

_LEAST_PART = 1 << 16

Place = tuple[int, int, int]
"""File, chunk (-1 = none) and offset of a message."""


@dataclass(frozen=True)
class Messages:
    """N messages of a topic by the time at which they were recorded.

    times: (N,) int64 nanoseconds, ascending.  places: (N, 3) int64 file, chunk, offset.
    """

    times: NDArray[np.int64]
    places: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.times)

    def place(self, row: int) -> Place:
        """Where the message of a row lies."""
        file, chunk, offset = self.places[row].tolist()
        return file, chunk, offset


def sort_messages(times: NDArray[np.int64], places: NDArray[np.int64]) -> Messages:
    """Messages by time; of one time, in the order given."""
    order = np.argsort(times, kind="stable")
    return Messages(times[order], places[order])


def join_messages(parts: Sequence[Messages]) -> Messages:
    """The messages of several files."""
    times = np.concatenate([part.times for part in parts] or [np.zeros(0, np.int64)])
    places = np.concatenate([part.places for part in parts] or [np.zeros((0, 3), np.int64)])
    return sort_messages(times, places)


class MessageStore(ABC):
    """The messages of a bag. The constructor raises DamagedFile and OSError. Thread-safe."""

    ros1: bool
    """Whether messages are serialized as in ROS 1; else they are CDR."""
    topics: dict[str, str]
    """Topic -> type, such as "sensor_msgs/msg/Image"."""

    @abstractmethod
    def find(self, topic: str) -> Messages:
        """All messages of a topic. Raises DamagedFile, OSError."""

    @abstractmethod
    def read(self, place: Place, first: int | None = None) -> bytes:
        """The bytes of a message, or the first ones. Raises DamagedFile, OSError."""

    def heads(self, messages: Messages, size: int) -> NDArray[np.uint8]:
        """(N, size) first bytes of messages, filled up with zeros. Raises DamagedFile, OSError."""
        found = np.zeros((len(messages), size), np.uint8)
        for row in np.lexsort(messages.places.T[::-1]).tolist():
            data = self.read(messages.place(row), size)
            found[row, : len(data)] = np.frombuffer(data, np.uint8)
        return found


def check_length(size: int) -> int:
    """The length of a message or chunk, if it is possible. Raises DamagedFile."""
    if not 0 <= size <= MOST_BYTES:
        raise DamagedFile(f"it is damaged: it states a part of {size} bytes")
    return size


def decompress(kind: str, data: bytes, most: int = MOST_BYTES) -> bytes:
    """The content of compressed bytes: "bz2", "lz4", "zstd"; "" and "none" = as they are. Raises DamagedFile, also for
    more than ``most`` bytes."""
    if kind in ("", "none"):
        return data
    try:
        found = _decompressed(kind, data, most + 1)
    except (OSError, RuntimeError, EOFError, ValueError) as error:
        raise DamagedFile(f"it is damaged: a part does not decompress ({kind})") from error
    except Exception as error:  # zstd's own error has no public base
        if type(error).__name__ != "ZstdError":
            raise
        raise DamagedFile(f"it is damaged: a part does not decompress ({kind})") from error
    if len(found) > most:
        raise DamagedFile(f"a part of it holds more than {most >> 20} MB, which is not read")
    return found


@functools.cache
def _zstd() -> Any:
    """The module zstd of Python 3.14, or its backport; a failed import takes long."""
    try:
        return importlib.import_module("compression.zstd")
    except ImportError:
        return importlib.import_module("backports.zstd")


def _unpack_lz4(data: bytes, most: int) -> bytes:
    """In parts, because lz4 takes the memory of the longest possible output for each."""
    from lz4.frame import LZ4FrameDecompressor

    unpacking = LZ4FrameDecompressor()
    parts, step = list[bytes](), max(_LEAST_PART, 4 * len(data))
    while most > 0 and not unpacking.eof:
        part = unpacking.decompress(b"" if parts else data, max_length=min(step, most))
        if not part:
            break
        parts.append(part)
        most -= len(part)
    return parts[0] if len(parts) == 1 else b"".join(parts)


def _decompressed(kind: str, data: bytes, most: int) -> bytes:
    if kind == "bz2":
        return bz2.BZ2Decompressor().decompress(data, most)
    if kind == "lz4":
        return _unpack_lz4(data, most)
    if kind == "zstd":
        return bytes(_zstd().ZstdDecompressor().decompress(data, max_length=most))
    raise DamagedFile(f"its compression {kind!r} is not known")
