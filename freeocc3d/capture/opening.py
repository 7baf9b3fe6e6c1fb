"""Finds the reader of a capture."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ..core.errors import CaptureError, ConfigError, printable
from ..core.regular_files import user_path
from ..settings import registry
from .base import Capture, Options

BUILTIN = "builtin:"
"""Prefix of paths that name a rendered scene, not a folder."""


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
        raise CaptureError(_explain_missing(folder))
    if not (folder.is_dir() or folder.is_file()):
        raise CaptureError(f"{folder} is neither a folder nor a regular file: give a folder of frames, or a video.")
    try:
        from .recognition import find_unread_depth, recognize  # imports OpenCV

        name = recognize(folder) if options.format == "auto" else options.format
        _check_kind(name, folder)
        opened = _construct(name, folder, options, backend_options or {})
        if options.format == "auto" and options.depth and not opened.has_depth and folder.is_dir():
            opened.warnings = (*opened.warnings, *find_unread_depth(folder, name))
        return opened
    except CaptureError as error:
        said = str(error)
        raise error if printable(str(folder)) in said else CaptureError(f"{folder}: {said}") from error
    except OSError as error:
        raise CaptureError(f"Cannot read {error.filename or folder}: {error.strerror}.") from error


def _explain_missing(path: Path) -> str:
    try:
        target = os.readlink(path)
    except (OSError, ValueError):
        return f"There is no folder or video {path}: check the path of the capture."
    return f"{path} is a link to {target}, which does not exist, or leads back to the link: correct the link."


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
