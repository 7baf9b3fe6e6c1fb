"""Pairs numbered color and depth files by number, and decodes the pairs; the readers of such files share it.

A frame that lacks one of its two files is broken, and reading it raises FrameError. If more than the share
``capture.max_broken`` of the frames are broken, the constructor raises CaptureError. With ``capture.depth=false`` only
color files count, and no depth file is read.
"""

from __future__ import annotations

import contextlib
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..core.errors import CaptureError, FrameError
from ..core.image_files import Size
from .base import Options
from .cameras.rigs import Rig
from .files.image_suffixes import DEPTH_SUFFIXES
from .files.numbered_files import list_folder
from .frame_files import FileFrames, FrameFiles, read_first_depth_size, read_first_size
from .images.depth_decoding import read_raw_depth
from .images.image_decoding import read_classes
from .rgbd_frames import Registration


@dataclass(frozen=True)
class Pairs:
    """Color and depth files of N frames, ascending by number. A missing file is None. If depth is not read, all depth
    files are None and ``depth_size`` equals ``color_size``.

    numbers: frame numbers in the file names.  color_size, depth_size: of the first readable image of each kind.
    """

    numbers: tuple[int, ...]
    color: tuple[Path | None, ...]
    depth: tuple[Path | None, ...]
    color_size: Size
    depth_size: Size


def pair_files(color: Mapping[int, Path], depth: Mapping[int, Path], folder: Path, options: Options) -> Pairs:
    """Pair the files by number, or take only color files if ``options.depth`` is false.

    Raises CaptureError: there is no color, no depth or no readable image, or too many frames lack a file.
    """
    if not color:
        raise CaptureError(f"{folder} holds no color images of this format.")
    if not options.depth:
        numbers = sorted(color)
        size = read_first_size(color.values(), folder)
        return Pairs(tuple(numbers), tuple(color[n] for n in numbers), (None,) * len(numbers), size, size)
    if not depth:
        raise CaptureError(
            f"{folder} holds {len(color)} color images but no depth{_other_depth(folder)}: add depth, or map color "
            "only with capture.depth=false."
        )
    numbers = sorted(color.keys() | depth.keys())
    incomplete = sorted(color.keys() ^ depth.keys())
    if len(incomplete) > options.max_broken * len(numbers):
        alone = color.get(incomplete[0]) or depth[incomplete[0]]
        missing = "depth" if incomplete[0] in color else "color"
        raise CaptureError(
            f"{folder} holds {len(color)} color and {len(depth)} depth images, and {len(incomplete)} frames lack one "
            f"of the two. The first is frame {incomplete[0]} ({alone.name} has no {missing} image). Complete the "
            "capture, or raise capture.max_broken."
        )
    return Pairs(
        tuple(numbers),
        tuple(map(color.get, numbers)),
        tuple(map(depth.get, numbers)),
        read_first_size(color.values(), folder),
        read_first_depth_size(depth.values(), folder),
    )


class ImagePairs(FileFrames):
    """A capture of numbered color and depth files by one rig; a reader finds the files and the cameras."""

    def __init__(self, path: Path, options: Options, pairs: Pairs, rig: Rig, units_per_meter: float | None):
        """units_per_meter: of depth that is stored as integers, unless ``options.depth_scale`` is set; None = nothing
        states it."""
        self._pairs = pairs
        numbered = enumerate(zip(pairs.color, pairs.depth, strict=True))
        frames = [FrameFiles(color, depth, rig, float(row)) for row, (color, depth) in numbered]
        super().__init__(path, options, frames, None if _holds_floats(pairs.depth) else units_per_meter)
        Registration(rig)  # raises CaptureError for a rig of too large images

    def _class_image(self, index: int, path: Path | None) -> NDArray[np.uint8] | None:
        """The class image at ``path`` on the frame's pixel grid. Raises FrameError if the file is unusable."""
        if path is None or not self.classes:
            return None
        return self.registration(index).classes(read_classes(path, len(self.classes), self._pairs.color_size))


def _holds_floats(depth: Sequence[Path | None]) -> bool:
    """Whether the first readable depth file holds floats, which have a unit of their own."""
    for path in depth:
        if path is None:
            continue
        if path.suffix.lower() in (".png", ".pgm"):
            return False
        with contextlib.suppress(FrameError):
            return bool(read_raw_depth(path).dtype.kind == "f")
    return False


def _other_depth(folder: Path) -> str:
    """What ``depth/`` holds instead of depth files, in words that start with a comma."""
    suffixes = Counter(Path(name).suffix.lower() for name in list_folder(folder / "depth") if name[0] != ".")
    if not suffixes:
        return ""
    suffix, count = suffixes.most_common(1)[0]
    if suffix in DEPTH_SUFFIXES:
        return f", for the names of the files in {folder / 'depth'} have no frame numbers"
    files = f"{count} {suffix or 'other'} files" if count > 1 else f"one {suffix or 'other'} file"
    return f", for {folder / 'depth'} has {files}; {', '.join(sorted(DEPTH_SUFFIXES))} are read"
