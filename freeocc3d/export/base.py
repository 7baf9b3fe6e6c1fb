"""The contract of an exporter, and the one way in which all of them write: whole or not at all.

An exporter is one file of this folder with ``Options`` and ``write(scan_map, path, options)``, which writes to ``path``
and may raise OSError or ExportError.
"""

from __future__ import annotations

import errno
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from .. import registry
from ..errors import ExportError
from ..store import Map


def export_map(
    scan_map: Map, format_name: str, path: str | Path, options: Mapping[str, Any] | None = None, overwrite: bool = False
) -> None:
    """Write a map to ``path`` in the format of that name.

    Raises ConfigError (unknown format, naming the nearest; unknown option), ExportError (the target exists or cannot be
    written, or the map has nothing to write).
    """
    exporter = registry.load("export", format_name)
    checked = registry.build_options(exporter, options or {})
    write_whole(Path(path), lambda target: exporter.write(scan_map, target, checked), overwrite)


def write_whole(path: Path, write: Callable[[Path], None], overwrite: bool = False) -> None:
    """Let ``write`` fill a temporary file beside ``path``, then give it the name. Raises ExportError."""
    if path.exists() and not overwrite:
        raise ExportError(f"{path} exists: choose another name, or replace it with --overwrite.")
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        write(temporary)
        temporary.replace(path)
    except OSError as error:
        reason = "the disk is full" if error.errno == errno.ENOSPC else (error.strerror or str(error)).lower()
        raise ExportError(f"Cannot write {path}: {reason}.") from error
    finally:
        temporary.unlink(missing_ok=True)
