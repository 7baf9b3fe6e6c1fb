"""Finds the reader of a capture."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ..core.errors import CaptureError, ConfigError
from ..core.regular_files import user_path
from ..settings import registry
from .base import Capture, Options
from .numbered_files import list_folder

VIDEO_SUFFIXES = {".mp4", ".m4v", ".mov", ".avi", ".mkv", ".webm"}
"""Suffixes of files that may be a capture, for the hint about an unrecognized folder."""

BUILTIN = "builtin:"
"""Prefix of paths that name a rendered scene, not a folder."""

_MOST_BELOW = 1000


def open_capture(
    path: str | Path, options: Options | None = None, backend_options: Mapping[str, Mapping[str, Any]] | None = None
) -> Capture:
    """Open the capture at ``path`` with the reader ``options.format``; "auto" picks the one that recognizes the folder.

    backend_options: reader name -> its own options; those of other readers are ignored.
    Raises CaptureError (missing folder, unknown layout, missing files), ConfigError (unknown format, option out of
    range), DependencyError.
    """
    options = options or Options()
    if str(path).startswith(BUILTIN):
        return _construct("synthetic", Path(path), options, backend_options or {})
    folder = user_path(path)
    if not os.path.exists(folder):
        raise CaptureError(f"There is no folder or video {folder}: check the path of the capture.")
    if not (folder.is_dir() or folder.is_file()):
        raise CaptureError(f"{folder} is neither a folder nor a regular file: give a folder of frames, or a video.")
    try:
        name = _recognize(folder) if options.format == "auto" else options.format
        _check_kind(name, folder)
        return _construct(name, folder, options, backend_options or {})
    except OSError as error:
        raise CaptureError(f"Cannot read {error.filename or folder}: {error.strerror}.") from error


def _check_kind(name: str, path: Path) -> None:
    """Raise CaptureError if a reader of folders is asked to read a file, or one of videos a folder."""
    reader = registry.load("capture.readers", name).Reader
    if path.is_file() and not reader.reads_files:
        raise CaptureError(f"{path} is a file, but capture.format={name} reads a folder of frames.")
    if path.is_dir() and reader.reads_files and not reader.recognizes(path):
        raise CaptureError(f"{path} is a folder, but capture.format={name} reads {reader.layout}.")


def select_frames(capture: Capture) -> range:
    """Indices of the frames that ``start``, ``stop`` and ``stride`` select. Raises CaptureError if there is none."""
    options = capture.options
    frames = range(len(capture))[options.start : options.stop : options.stride]
    if not frames:
        raise CaptureError(
            f"No frame of {capture.path} is selected: it has {len(capture)} frames, and capture.start = "
            f"{options.start}, capture.stop = {options.stop} select none of them. Change these options."
        )
    return frames


def _construct(name: str, path: Path, options: Options, own: Mapping[str, Mapping[str, Any]]) -> Capture:
    module = registry.load("capture.readers", name)
    extra = registry.build_options(module, own.get(name) or {}, f"capture.{name}.")
    opened: Capture = module.Reader(path, options, *([] if extra is None else [extra]))
    if options.scale is not None and opened.has_depth:
        raise ConfigError(
            f"capture.scale is for scans without depth, but {path} has depth, which gives the scale: "
            "leave capture.scale out, or set capture.depth=false."
        )
    return opened


def _recognize(folder: Path) -> str:
    """Name of the reader that recognizes the folder. Raises CaptureError if none does, or several do."""
    readers = {name: reader for name, reader in _readers().items() if reader.reads_files or not folder.is_file()}
    found = [name for name, reader in readers.items() if not reader.general and reader.recognizes(folder)]
    found = found or [name for name, reader in readers.items() if reader.general and reader.recognizes(folder)]
    if len(found) > 1:
        raise CaptureError(f"{folder} may be of the format {' or '.join(found)}: choose one with capture.format.")
    if found:
        return found[0]
    raise CaptureError(
        f"{folder} is not a capture of a known format{_below(folder, readers)}. Looked for: "
        + "; ".join(f"{reader.layout} ({name})" for name, reader in readers.items())
        + "."
    )


def _readers() -> dict[str, type[Capture]]:
    """Readers by name, without those that need a missing package."""
    names = [name for name, backend in registry.backends("capture.readers").items() if not backend.missing]
    return {name: registry.load("capture.readers", name).Reader for name in names}


def _below(folder: Path, readers: Mapping[str, type[Capture]]) -> str:
    """A hint at the first subfolder that is a capture, as in data sets of several, or at the first video."""
    for child in (folder / name for name in list_folder(folder)[:_MOST_BELOW]):
        if child.is_dir() and any(reader.recognizes(child) for reader in readers.values()):
            return f", but {child} is: give that folder"
        if child.is_file() and child.suffix.lower() in VIDEO_SUFFIXES:
            return f", but {child} may be: give that file"
    return ""
