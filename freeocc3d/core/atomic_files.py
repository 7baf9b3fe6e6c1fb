"""Writes files and folders completely or not at all, also when the process is killed or the power fails."""

from __future__ import annotations

import ctypes
import errno
import os
import shutil
from collections.abc import Callable
from pathlib import Path

from .errors import ExportError

_TEMPORARY = "tmp"
_HERE, _EXCHANGE = -100, 2  # AT_FDCWD and RENAME_EXCHANGE, man 2 renameat2


def replace_file(path: Path, write: Callable[[Path], object]) -> None:
    """Let ``write`` fill a temporary file in the folder of ``path``, with the same suffix, then rename it to ``path``.
    A reader always finds a complete file, the old or the new one. Raises OSError."""
    temporary = path.with_name(f".{path.stem}.{os.getpid()}.{_TEMPORARY}{path.suffix}")
    try:
        write(temporary)
        sync(temporary)
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def replace_text(path: Path, text: str) -> None:
    """Write a text with ``replace_file``. Raises OSError."""
    replace_file(path, lambda temporary: temporary.write_text(text, encoding="utf-8"))


def sync(path: Path) -> None:
    """Wait until the content of a file, or the names in a folder, are on the disk; some file systems, such as those of
    shared folders, cannot tell for folders. Raises OSError."""
    descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.EBADF, errno.ENOSYS, errno.EOPNOTSUPP) or not path.is_dir():
            raise
    finally:
        os.close(descriptor)


def exchange(one: Path, other: Path) -> bool:
    """Give each of two files or folders the name of the other, at one moment. Returns False, and changes nothing, on
    systems and file systems that cannot. Raises OSError if they can but may not."""
    try:
        renameat2 = ctypes.CDLL(None, use_errno=True).renameat2
    except (OSError, AttributeError):  # not Linux, or an old C library
        return False
    if renameat2(_HERE, os.fsencode(one), _HERE, os.fsencode(other), ctypes.c_uint(_EXCHANGE)) == 0:
        return True
    number = ctypes.get_errno()
    if number in (errno.EINVAL, errno.ENOSYS, errno.EOPNOTSUPP):
        return False
    raise OSError(number, os.strerror(number), str(one))


def is_temporary(path: Path) -> bool:
    """Whether this is a temporary file of ``replace_file`` that an interrupted process left."""
    return path.name.startswith(".") and _TEMPORARY in path.name.split(".")


def refuse_existing(path: Path, overwrite: bool = False) -> None:
    """Raise ExportError if the file exists or its folder does not, before any work whose result cannot be written."""
    if not path.parent.is_dir():
        raise ExportError(f"Cannot write {path}: there is no folder {path.parent}. Create it first.")
    if path.exists() and not overwrite:
        raise ExportError(f"{path} already exists: choose another name, or replace it with --overwrite.")
    if path.is_dir():
        raise ExportError(f"{path} is a folder, and a folder is never replaced: choose another name.")


def write_whole(path: Path, write: Callable[[Path], None], overwrite: bool = False) -> None:
    """Let ``write`` fill a file or folder of that name, and its companion files, in a temporary folder next to it.
    Then move everything, ``path`` last. Raises ExportError."""
    refuse_existing(path, overwrite)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.{_TEMPORARY}")
    try:
        temporary.mkdir()
        write(temporary / path.name)
        beside = [made for made in sorted(temporary.iterdir()) if made.name != path.name]
        for made in beside:
            refuse_existing(path.with_name(made.name), overwrite)
        for made in [*beside, temporary / path.name]:
            made.replace(path.with_name(made.name))
    except OSError as error:
        reason = "the disk is full" if error.errno == errno.ENOSPC else (error.strerror or str(error)).lower()
        raise ExportError(f"Cannot write {path}: {reason}.") from error
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
