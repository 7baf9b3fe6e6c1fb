"""Pairs numbered color and depth files by number, and decodes the pairs; the readers of such files share it.

A frame that lacks one of its two files is broken, and reading it raises FrameError. If more than the share
``capture.max_broken`` of the frames are broken, the constructor raises CaptureError. With ``capture.depth=false`` only
color files count, and no depth file is read.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..core.errors import CaptureError, FrameError
from ..core.image_files import Size
from ..core.types import Frame
from .base import Capture, Options
from .depth_registration import PixelGrid
from .image_decoding import convert_to_meters, image_size, read_classes, read_color, read_depth

MOST_FRAME_PIXELS = 1 << 25
"""Largest frame: that of an 8K video. A run keeps several frames in memory, with 7 bytes per pixel."""


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
        size = _first_size(color.values(), folder)
        return Pairs(tuple(numbers), tuple(color[n] for n in numbers), (None,) * len(numbers), size, size)
    if not depth:
        raise CaptureError(
            f"{folder} holds {len(color)} color images but no depth: add depth, or map color only with "
            "capture.depth=false."
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
        _first_size(color.values(), folder),
        _first_size(depth.values(), folder),
    )


class ImagePairs(Capture):
    """A capture of numbered color and depth files; a reader finds the files and the cameras."""

    def __init__(self, path: Path, options: Options, pairs: Pairs, grid: PixelGrid, units_per_meter: float):
        """units_per_meter: of the stored depth, unless ``options.depth_scale`` is set."""
        super().__init__(path, options)
        width, height = grid.intrinsics.width, grid.intrinsics.height
        if width * height > MOST_FRAME_PIXELS:
            raise CaptureError(
                f"The frames of {path} have {width} x {height} pixels, but at most {MOST_FRAME_PIXELS / 1e6:.0f} "
                "million are possible: reduce the images."
            )
        self._pairs = pairs
        self._grid = grid
        self._units_per_meter = options.depth_scale or units_per_meter
        self.has_depth = options.depth
        self.timestamps = np.arange(len(pairs.numbers), dtype=np.float64)

    def __getitem__(self, index: int) -> Frame:
        color_path, depth_path = self._files(index)
        color = self._grid.color(read_color(color_path, self._pairs.color_size))
        if depth_path is None:
            depth_m = np.zeros(color.shape[:2], np.float32)
        else:
            raw = read_depth(depth_path, self._pairs.depth_size)
            depth_m = self._grid.depth(convert_to_meters(raw, self._units_per_meter, self.options.max_depth))
        return Frame(index, float(self.timestamps[index]), color, depth_m, self._grid.intrinsics)

    def name(self, index: int) -> str:
        path = self._pairs.color[index]
        return path.name if path else ""

    def raw_depth(self, index: int) -> tuple[NDArray[np.uint16], float] | None:
        path = self._files(index)[1]
        return None if path is None else (read_depth(path, self._pairs.depth_size), self._units_per_meter)

    def _class_image(self, path: Path | None) -> NDArray[np.uint8] | None:
        """The class image at ``path`` on the frames' pixel grid. Raises FrameError if the file is unusable."""
        if path is None or not self.classes:
            return None
        return self._grid.classes(read_classes(path, len(self.classes), self._pairs.color_size))

    def _files(self, index: int) -> tuple[Path, Path | None]:
        """The color file of a frame and, if depth is read, its depth file."""
        if not 0 <= index < len(self):
            raise IndexError(f"Frame {index} of a capture of {len(self)} frames.")
        color, depth = self._pairs.color[index], self._pairs.depth[index]
        if color is None or (depth is None and self.has_depth):
            alone, missing = (color, "depth") if color else (depth, "color")
            raise FrameError(f"Frame {self._pairs.numbers[index]} has no {missing} image for {alone}.")
        return color, depth


def _first_size(paths: Iterable[Path], folder: Path) -> Size:
    for path in paths:
        try:
            return image_size(path)
        except FrameError:
            continue
    raise CaptureError(f"No image of {folder} can be read: all are damaged, or are not images.")
