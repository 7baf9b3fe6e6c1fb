"""Finds the reader of a capture, and warns if its depth does not look like a room."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ..core.errors import CaptureError, ConfigError, FrameError
from ..core.regular_files import user_path
from ..core.warnings import Notice
from ..settings import registry
from .base import Capture, Options
from .numbered_files import list_folder

VIDEO = "video"
"""The reader of video files; all others read folders."""

VIDEO_SUFFIXES = {".mp4", ".m4v", ".mov", ".avi", ".mkv", ".webm"}
"""Suffixes of files that may be a capture, for the hint about an unrecognized folder."""

BUILTIN = "builtin:"
"""Prefix of paths that name a rendered scene, not a folder."""

USUAL_UNITS = (1.0, 100.0, 1000.0, 5000.0, 6553.5, 10000.0)
"""Common depth units per meter."""

INDOOR_MEDIAN_M = 0.1, 20.0
"""Range of the median depth of an indoor scan, meters."""

TYPICAL_MEDIAN_M = 2.0

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
    is_video = options.format == VIDEO or (options.format == "auto" and folder.is_file())
    if folder.is_file() != is_video:
        raise CaptureError(
            f"{folder} is a {'folder' if is_video else 'file'}, but capture.format={options.format} reads a "
            f"{'video file' if is_video else 'folder of frames'}."
        )
    try:
        name = VIDEO if is_video else _recognize(folder) if options.format == "auto" else options.format
        return _construct(name, folder, options, backend_options or {})
    except OSError as error:
        raise CaptureError(f"Cannot read {error.filename or folder}: {error.strerror}.") from error


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


def check_depth_scale(capture: Capture, samples: int = 5) -> Notice | None:
    """A warning if depth seems to be stored in other units than assumed; else None.

    Samples frames across the capture, before depth is clipped at ``max_depth``: clipping would remove all depth that is
    read 1000 times too large.
    """
    median_units, within, units_per_meter = _sample_depth(capture, samples)
    if median_units is None:
        return None
    median_m = median_units / units_per_meter
    nearest, farthest = INDOOR_MEDIAN_M
    if nearest <= median_m <= farthest and within >= 0.05:
        return None
    likely = min(USUAL_UNITS, key=lambda units: abs(math.log(median_units / units / TYPICAL_MEDIAN_M)))
    advice = f"capture.depth_scale is probably {likely:g} and not {units_per_meter:g}"
    if likely == units_per_meter:
        advice = "check capture.depth_scale and capture.max_depth"
    return Notice(
        "depth-scale-doubtful",
        f"The depth of {capture.path} does not look like a room: its median is {median_m:.3g} m, and {within:.0%} of "
        f"it lies within capture.max_depth = {capture.options.max_depth:g} m; {advice}.",
    )


def _sample_depth(capture: Capture, samples: int) -> tuple[float | None, float, float]:
    """Median of the stored depth (None without depth), its share within ``max_depth``, and the units per meter."""
    values, units_per_meter = [], 1.0
    for index in np.unique(np.linspace(0, len(capture) - 1, samples).astype(int)).tolist():
        try:
            stored = capture.raw_depth(index)
        except FrameError:
            continue
        if stored is not None:
            raw, units_per_meter = stored
            values.append(raw[(raw > 0) & (raw < np.iinfo(raw.dtype).max)])
    measured = np.concatenate(values) if values else np.zeros(0)
    if not len(measured):
        return None, 0.0, units_per_meter
    within = float((measured <= capture.options.max_depth * units_per_meter).mean())
    return float(np.median(measured)), within, units_per_meter


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
    readers = _readers()
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
