"""Writes files completely or not at all."""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Callable
from pathlib import Path

from .errors import ExportError

_TEMPORARY = "tmp"


def replace_file(path: Path, write: Callable[[Path], object]) -> None:
    """Let ``write`` fill a temporary file in the folder of ``path``, with the same suffix, then rename it to ``path``.
    A reader always finds a complete file, the old or the new one. Raises OSError."""
    temporary = path.with_name(f".{path.stem}.{os.getpid()}.{_TEMPORARY}{path.suffix}")
    try:
        write(temporary)
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def replace_text(path: Path, text: str) -> None:
    """Write a text with ``replace_file``. Raises OSError."""
    replace_file(path, lambda temporary: temporary.write_text(text, encoding="utf-8"))


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
