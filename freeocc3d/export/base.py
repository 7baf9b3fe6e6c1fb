"""The contract of an exporter, and the one way in which all of them write: whole or not at all.

An exporter is one file of this folder with ``Options`` and ``write(scan_map, path, options)``: it writes to ``path``,
may raise OSError or ExportError, and returns what the user should know, in sentences, or None. ``path`` has its final
name in a folder of its own: what a format needs beside it (an image, a description) is written into that folder, and
moves with it. An exporter that has the option ``frame`` takes its voxels from ``frames.placed``.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ..core.atomic_files import write_whole
from ..query.scan_map import Map
from ..settings import registry


def export_map(
    scan_map: Map, format_name: str, path: str | Path, options: Mapping[str, Any] | None = None, overwrite: bool = False
) -> list[str]:
    """Write a map to ``path`` in the format of that name; returns what the user should know of it, in sentences.

    Raises ConfigError (unknown format, naming the nearest; unknown option), ExportError (the target exists or cannot be
    written, or the map has nothing to write).
    """
    exporter = registry.load("export", format_name)
    checked = registry.build_options(exporter, options or {}, f"{format_name}.")
    notes: list[str] = []
    write_whole(Path(path), lambda target: notes.extend(exporter.write(scan_map, target, checked) or []), overwrite)
    return notes
