"""The files of a capture, in a folder or in a zip archive. Nothing is unpacked to the disk.

Source: PKWARE's APPNOTE (the records at the end of an archive).
"""

from __future__ import annotations

import contextlib
import struct
import weakref
import zipfile
import zlib
from abc import ABC, abstractmethod
from pathlib import Path
from typing import BinaryIO

from ...core.errors import CaptureError, FrameError
from ...core.regular_files import open_regular, read_bytes
from .numbered_files import list_folder

MOST_MEMBERS = 200_000
"""Most members of an archive: the color, depth and confidence of half an hour."""

_LONGEST_DIRECTORY = MOST_MEMBERS * 256
_END, _END_64 = b"PK\x05\x06", b"PK\x06\x06"
_LONGEST_END = (1 << 16) + 22
_ERRORS = (OSError, ValueError, EOFError, RuntimeError, zlib.error, zipfile.BadZipFile, struct.error)
"""What zipfile raises for members that are damaged, encrypted or packed in an unknown way."""


class PackedFiles(ABC):
    """Files by their names, which have slashes."""

    path: Path

    @abstractmethod
    def list(self, folder: str) -> list[str]:
        """The names in a folder, "" = the topmost one; empty if there is none. Raises CaptureError."""

    @abstractmethod
    def read(self, name: str, limit: int) -> bytes:
        """The content of a file of at most ``limit`` bytes. Thread-safe. Raises FrameError."""

    def source(self, name: str) -> Path:
        """What a file is called in messages."""
        return self.path / name


class FolderFiles(PackedFiles):
    """The files below a folder."""

    def __init__(self, path: Path):
        self.path = path

    def list(self, folder: str) -> list[str]:
        return list_folder(self.path / folder)

    def read(self, name: str, limit: int) -> bytes:
        try:
            return read_bytes(self.path / name, limit)
        except OSError as error:
            raise FrameError(f"Cannot read {self.path / name}: {error.strerror}.") from error


class ZipFiles(PackedFiles):
    """The members of a zip archive. The constructor raises CaptureError for another file, a damaged one, or one of more
    than ``MOST_MEMBERS``."""

    def __init__(self, path: Path):
        self.path = path
        with contextlib.ExitStack() as stack:
            try:
                stream = stack.enter_context(open_regular(path))
                _check_directory(stream, path)
                archive = stack.enter_context(zipfile.ZipFile(stream))
            except FileNotFoundError as error:
                raise CaptureError(f"There is no file {path}.") from error
            except _ERRORS as error:
                reason = getattr(error, "strerror", None) or "it is cut off, or no zip archive"
                raise CaptureError(f"Cannot read {path}: {reason}. Copy it again.") from error
            self._archive, self._members = archive, {info.filename: info for info in archive.infolist()}
            weakref.finalize(self, stack.pop_all().close)
        if len(self._members) > MOST_MEMBERS:
            raise _too_many(path)
        self._folders: dict[str, list[str]] = {}
        for name in sorted(self._members):
            folder, _, last = name.rpartition("/")
            if last:
                self._folders.setdefault(folder, []).append(last)

    def list(self, folder: str) -> list[str]:
        return self._folders.get(folder, [])

    def read(self, name: str, limit: int) -> bytes:
        info = self._members.get(name)
        if info is None:
            raise FrameError(f"{self.path} has no member {name}.")
        if info.file_size > limit:
            raise FrameError(f"{self.source(name)} unpacks to more than the {limit >> 20} MB that it can have.")
        if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise FrameError(f"{self.source(name)} is packed in a way that is not read: pack it with deflate.")
        try:
            with self._archive.open(info) as stream:
                data = stream.read(info.file_size)
        except _ERRORS as error:
            raise FrameError(f"{self.source(name)} is damaged: {' '.join(str(error).split())}.") from error
        if len(data) < info.file_size:
            raise FrameError(f"{self.source(name)} is cut off: {len(data)} of {info.file_size} bytes.")
        return data


def is_zip(path: Path) -> bool:
    """Whether ``path`` is a file that starts as a zip archive with a member does."""
    try:
        with open_regular(path) as stream:
            return stream.read(4) == b"PK\x03\x04"
    except OSError:
        return False


def _check_directory(stream: BinaryIO, path: Path) -> None:
    """Refuse a directory of members that takes too much memory, by what the end of the archive states."""
    size = stream.seek(0, 2)
    stream.seek(max(0, size - _LONGEST_END - 76))
    tail = stream.read()
    at = tail.rfind(_END)
    if at < 0:
        raise zipfile.BadZipFile
    count, length = struct.unpack_from("<HI", tail, at + 10)
    at_64 = tail.rfind(_END_64, 0, at)
    if at_64 >= 0:
        count, length = struct.unpack_from("<QQ", tail, at_64 + 32)
    if count > MOST_MEMBERS or length > _LONGEST_DIRECTORY:
        raise _too_many(path)
    stream.seek(0)


def _too_many(path: Path) -> CaptureError:
    return CaptureError(f"{path} holds more than {MOST_MEMBERS:,} members, more than a capture can have.")
