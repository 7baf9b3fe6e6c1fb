"""Reads parts of large files, for formats that one file holds: containers of video and of messages."""

from __future__ import annotations

import os
import weakref
from pathlib import Path
from typing import Protocol

from ...core.regular_files import open_regular


class DamagedFile(ValueError):
    """A file is damaged, cut off or of another kind. The message is the end of a sentence that starts with its name."""


class Bytes(Protocol):
    """Bytes of a file or in memory."""

    size: int

    def read(self, offset: int, size: int) -> bytes:
        """Exactly so many bytes. Raises DamagedFile if there are fewer."""


class FileBytes:
    """The bytes of a regular file. Thread-safe."""

    def __init__(self, path: Path):
        with open_regular(path) as stream:
            self.size = stream.seek(0, os.SEEK_END)
            if self.size:
                self._descriptor = os.dup(stream.fileno())
                weakref.finalize(self, os.close, self._descriptor)

    def read(self, offset: int, size: int) -> bytes:
        """Exactly so many bytes. Raises DamagedFile if there are fewer."""
        _check(offset, size, self.size)
        data = os.pread(self._descriptor, size, offset) if size else b""
        _check(0, size, len(data))
        return data


class HeldBytes:
    """Bytes in memory, such as those of a decompressed chunk."""

    def __init__(self, data: bytes):
        self._data, self.size = data, len(data)

    def read(self, offset: int, size: int) -> bytes:
        """Exactly so many bytes. Raises DamagedFile if there are fewer."""
        _check(offset, size, self.size)
        return self._data[offset : offset + size]


def _check(offset: int, size: int, end: int) -> None:
    if offset < 0 or size < 0 or offset + size > end:
        raise DamagedFile("it is cut off or damaged: a record reaches beyond its end")
