"""The contract of an exporter. An export is written whole or not at all.

An exporter is a module of this folder with ``Options`` and ``write(scan_map, path, options)``. ``write`` writes to
``path``, may raise OSError or ExportError, and returns sentences for the user, or None. ``path`` has its final name but
lies in a temporary folder. Companion files (an image, a description) go into that folder and move with it. An exporter
with the option ``frame`` takes its voxels from ``export_frames.place_voxels``.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ..core.atomic_files import write_whole
from ..query.scan_map import Map
from ..settings import registry
from .file_names import check_name


def export_map(
    scan_map: Map, format_name: str, path: str | Path, options: Mapping[str, Any] | None = None, overwrite: bool = False
) -> list[str]:
    """Writes a map to ``path`` in the named format. Returns sentences for the user.

    Raises ConfigError (unknown format, with the nearest name; unknown option; an ending of
    another format), ExportError (the target exists or cannot
    be written, or the map has nothing to write).
    """
    exporter = registry.load("export", format_name)
    checked = registry.build_options(exporter, options or {}, f"{format_name}.")
    check_name(format_name, Path(path))
    notes: list[str] = []
    write_whole(Path(path), lambda target: notes.extend(exporter.write(scan_map, target, checked) or []), overwrite)
    return notes
