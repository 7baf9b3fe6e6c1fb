"""RGB-D frames whose color, depth and confidence are image files."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.errors import CaptureError, FrameError
from ..core.image_files import Size
from ..core.warnings import Notice
from .base import Options
from .cameras.rigs import Rig, StatedCameras, build_rig
from .image_headers import read_rough_lens
from .images.depth_decoding import RawDepth, read_depth_size, read_raw_depth
from .images.image_decoding import count_color_bits, decode_image, image_size, read_color
from .rgbd_frames import RgbdFrames, normalize_confidence


@dataclass(frozen=True)
class FrameFiles:
    """The files of one frame, its rig, its (4, 4) T_world_cam or None, and its time in seconds. A frame that lacks its
    color or depth file is broken."""

    color: Path | None
    depth: Path | None
    rig: Rig
    time: float
    T_world_cam: NDArray[np.float64] | None = None
    confidence: Path | None = None


class FileFrames(RgbdFrames):
    """Frames of files. A reader lists the files and finds the rigs."""

    def __init__(self, path: Path, options: Options, frames: Sequence[FrameFiles], units_per_meter: float | None):
        """frames: with ascending times.  units_per_meter: of stored depth; None = nothing states it."""
        super().__init__(path, options, np.array([frame.time for frame in frames], np.float64), units_per_meter)
        self.frames = tuple(frames)
        self._color_bits = count_color_bits([frame.color for frame in frames if frame.color is not None])

    def stored_color(self, index: int) -> NDArray[np.uint8]:
        camera = self.rig(index).color.camera
        return read_color(self._files(index)[0], (camera.width, camera.height), self._color_bits)

    def stored_depth(self, index: int) -> RawDepth | None:
        path, camera = self._files(index)[1], self.rig(index).depth.camera
        return None if path is None else read_raw_depth(path, (camera.width, camera.height))

    def stored_confidence(self, index: int) -> NDArray[np.uint8] | None:
        path = self.frames[index].confidence
        return None if path is None else read_confidence(path)

    def rig(self, index: int) -> Rig:
        return self.frames[index].rig

    def name(self, index: int) -> str:
        color = self.frames[index].color
        return color.name if color else ""

    def files(self, index: int) -> tuple[Path, ...]:
        frame = self.frames[index]
        depth = (frame.depth, frame.confidence) if self.has_depth else ()
        return tuple(path for path in (frame.color, *depth) if path is not None)

    def pose(self, index: int) -> NDArray[np.float64] | None:
        return self.frames[index].T_world_cam

    def _files(self, index: int) -> tuple[Path, Path | None]:
        """The color file of a frame and, if depth is read, its depth file. Raises FrameError if one is missing."""
        if not 0 <= index < len(self):
            raise IndexError(f"Frame {index} of a capture of {len(self)} frames.")
        color, depth = self.frames[index].color, self.frames[index].depth
        if color is None or (depth is None and self.has_depth):
            alone, missing = (color, "depth") if color else (depth, "color")
            raise FrameError(f"A frame has no {missing} image for {alone}.")
        return color, depth if self.has_depth else None


def build_file_rig(
    stated: StatedCameras, options: Options, color: Sequence[Path], color_size: Size, depth_size: Size | None
) -> tuple[Rig, bool, bool]:
    """The rig of image files of these sizes, as ``build_rig`` makes it, whether the color camera is known, and whether
    its focal length is stated at least roughly: if nothing else states it, EXIF data may."""
    rig, known = build_rig(stated, options, color_size, depth_size)
    rough = None if known else read_rough_lens(color, color_size)
    if rough is not None:
        rig, _ = build_rig(StatedCameras(rough), options, color_size, depth_size)
    return rig, known, known or rough is not None


def read_confidence(path: Path) -> NDArray[np.uint8]:
    """Read (H, W) confidence: 0 = low, 1 = medium, 2 = high. Raises FrameError."""
    image = decode_image(path, cv2.IMREAD_UNCHANGED)
    if image.ndim != 2 or image.dtype != np.uint8:
        raise FrameError(f"{path} is not an 8-bit gray image of confidence.")
    return normalize_confidence(image)


def read_first_size(paths: Iterable[Path], folder: Path, read: Callable[[Path], Size] = image_size) -> Size:
    """The size of the first readable image; ``read`` is ``image_size`` or ``read_depth_size``. Raises CaptureError if
    no image is readable."""
    reason = ""
    for path in paths:
        try:
            return read(path)
        except FrameError as error:
            reason = reason or str(error)
    raise CaptureError(f"No image of {folder} can be read: {reason or 'there is none.'}")


def read_first_depth_size(paths: Iterable[Path], folder: Path) -> Size:
    """The size of the first readable depth file. Raises CaptureError if none is readable."""
    return read_first_size(paths, folder, read_depth_size)


def notice_left_out(count: int, total: int, folder: Path, first: str, reason: str) -> Notice:
    """Warns that frames are left out because of what they lack. first: the first of them.  reason: the rest of the
    sentence, such as "has no depth image"."""
    return Notice(
        "images-left-out",
        f"{count} of the {total} frames of {folder} {'is' if count == 1 else 'are'} left out: the first, {first}, "
        f"{reason}.",
    )
