"""Reads files that come from outside. Only regular files are opened, so that a pipe or device can neither block nor
fill the memory; and no file is read that is larger than its kind can be."""

from __future__ import annotations

import contextlib
import errno
import io
import os
import re
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

TEXT_BYTES = 256 << 20
"""Largest text file that is read: the poses or the class names of millions of frames."""

IMAGE_BYTES = 512 << 20
"""Largest encoded image that is read."""

MOST_ENTRIES = 500_000
"""Most entries of a folder that is listed: the frames of hours."""

_KINDS = (
    (stat.S_ISDIR, "a folder"), (stat.S_ISFIFO, "a pipe"), (stat.S_ISSOCK, "a socket"), (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
)  # fmt: skip


_ESCAPED = re.compile(r"\\u(dc[89a-f][0-9a-f])")


class UnusableFile(OSError):
    """A file that must not be read: no regular file, or too large. ``strerror`` says which, as part of a sentence."""


def check_regular(path: Path, limit: int | None = None) -> os.stat_result:
    """The status of a regular file of at most ``limit`` bytes; links are followed.

    Raises OSError: no such file, a loop of links, a name that no file can have; UnusableFile for any other kind of
    file, or a larger one. Never blocks.
    """
    try:
        found = path.stat()
    except ValueError as error:  # a NUL in the name
        raise OSError(errno.EINVAL, "the name of the file is invalid", str(path)) from error
    _refuse(path, found, limit)
    return found


def check_content(path: Path, limit: int | None = None) -> os.stat_result:
    """``check_regular`` for a file that a library opens by its path: an empty one raises UnusableFile, too. Files of
    /proc state no size, and reading them may block."""
    found = check_regular(path, limit)
    if not found.st_size:
        raise UnusableFile(errno.ENODATA, "it is empty", str(path))
    return found


@contextlib.contextmanager
def open_regular(path: Path, limit: int | None = None) -> Iterator[BinaryIO]:
    """Open a regular file to read bytes. Raises what ``check_regular`` raises, also if the file is replaced
    meanwhile. A file that states no size is empty: reading those of /proc may block."""
    check_regular(path, limit)
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    with os.fdopen(descriptor, "rb") as stream:
        found = os.fstat(stream.fileno())
        _refuse(path, found, limit)
        yield stream if found.st_size else io.BytesIO()


def read_bytes(path: Path, limit: int) -> bytes:
    """The content of a regular file of at most ``limit`` bytes. Raises OSError, as ``check_regular`` does."""
    with open_regular(path, limit) as stream:
        size = stream.seek(0, 2)
        stream.seek(0)
        data = stream.read(size + 1)  # not limit + 1: the stream takes memory for all that it is asked for
        if len(data) > size:
            data += stream.read(limit + 1 - len(data))
    if len(data) > limit:  # it grew meanwhile, or it is one of the files whose size is not known before
        raise _too_large(path, limit)
    return data


def read_text(path: Path, limit: int = TEXT_BYTES) -> str:
    """The text of a regular file in UTF-8, with or without a byte order mark. Raises OSError as ``check_regular``
    does, and UnicodeDecodeError, a ValueError."""
    return read_bytes(path, limit).decode("utf-8-sig")


def user_path(path: str | Path) -> Path:
    """The path that a user gives, with ``~`` as the home folder where there is one."""
    try:
        return Path(path).expanduser()
    except RuntimeError:  # there is no such user, or no home
        return Path(path)


def stored_path(text: str) -> Path:
    """The path that a document states, in which ``dump_yaml`` has written bytes that are not text as escapes."""
    if os.path.lexists(text):
        return Path(text)
    return Path(_ESCAPED.sub(lambda found: chr(int(found[1], 16)), text))


def list_names(folder: Path) -> list[str]:
    """The names in a folder, sorted. Raises OSError: no folder, or one of more than ``MOST_ENTRIES``."""
    names = []
    with os.scandir(folder) as entries:
        for entry in entries:
            names.append(entry.name)
            if len(names) > MOST_ENTRIES:
                raise UnusableFile(errno.EFBIG, f"it holds more than {MOST_ENTRIES:,} files", str(folder))
    return sorted(names)


def _refuse(path: Path, found: os.stat_result, limit: int | None) -> None:
    if not stat.S_ISREG(found.st_mode):
        kind = next((name for test, name in _KINDS if test(found.st_mode)), "a special file")
        raise UnusableFile(errno.EINVAL, f"it is {kind}, not a regular file", str(path))
    if limit is not None and found.st_size > limit:
        raise _too_large(path, limit)


def _too_large(path: Path, limit: int) -> UnusableFile:
    return UnusableFile(errno.EFBIG, f"it has more than the {limit >> 20} MB that such a file can have", str(path))
