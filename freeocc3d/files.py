"""Files that are written whole or not at all."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable
from pathlib import Path

from .errors import ExportError


def refuse_existing(path: Path, overwrite: bool = False) -> None:
    """Raises ExportError if the file exists or its folder does not: before work is done that could not be written."""
    if not path.parent.is_dir():
        raise ExportError(f"Cannot write {path}: there is no folder {path.parent}.")
    if path.exists() and not overwrite:
        raise ExportError(f"{path} exists: choose another name, or replace it with --overwrite.")


def write_whole(path: Path, write: Callable[[Path], None], overwrite: bool = False) -> None:
    """Let ``write`` fill a temporary file beside ``path``, then give it the name. Raises ExportError."""
    refuse_existing(path, overwrite)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        write(temporary)
        temporary.replace(path)
    except OSError as error:
        reason = "the disk is full" if error.errno == errno.ENOSPC else (error.strerror or str(error)).lower()
        raise ExportError(f"Cannot write {path}: {reason}.") from error
    finally:
        temporary.unlink(missing_ok=True)
