"""Decodes color, depth and class images, and raises an error for incomplete files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.errors import FrameError
from ..core.image_files import ImageFileError, Size, WrongSizeError, read_image, read_image_size

SATURATED = np.iinfo(np.uint16).max
"""The value that sensors and renderers store for a depth that exceeds 16 bits."""


def read_color(path: Path, size: Size | None = None) -> NDArray[np.uint8]:
    """Read (H, W, 3) uint8 RGB as stored. The EXIF orientation is not applied, because depth and intrinsics ignore it.

    size: the (width, height) that it must have, if known. Raises FrameError if the file is missing, cut off, not an
    image, or of another size.
    """
    image = _decode(path, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION, size)
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB, dst=image)


def read_depth(path: Path, size: Size | None = None) -> NDArray[np.uint16]:
    """Read (H, W) uint16 depth as stored. Raises FrameError as ``read_color`` does, also for an image that is not
    16-bit gray."""
    image = _decode(path, cv2.IMREAD_UNCHANGED, size)
    if image.ndim != 2 or image.dtype != np.uint16:
        raise FrameError(f"{path} is not a depth image: expected 16-bit gray, got {_kind(image)}.")
    return image


def read_classes(path: Path, count: int, size: Size | None = None) -> NDArray[np.uint8]:
    """Read an (H, W) class image with values below ``count``. Many programs write 255 for "nothing"; it becomes 0
    unless it has a name. Raises FrameError as ``read_color`` does, also for a value without a class."""
    image = _decode(path, cv2.IMREAD_UNCHANGED, size)
    if image.ndim != 2 or image.dtype not in (np.uint8, np.uint16):
        raise FrameError(f"{path} is not a class image: expected 8- or 16-bit gray, got {_kind(image)}.")
    if count <= 255:
        image[image == 255] = 0
    if (largest := int(image.max())) >= count:
        raise FrameError(f"{path} holds class {largest}, but only {count} classes have names (0…{count - 1}).")
    return image.astype(np.uint8, copy=False)


def convert_to_meters(raw: NDArray[np.uint16], units_per_meter: float, max_depth: float) -> NDArray[np.float32]:
    """Convert stored depth to float32 meters. Saturated values and those beyond ``max_depth`` meters become 0."""
    depth_m = raw.astype(np.float32)
    depth_m *= np.float32(1.0 / units_per_meter)
    limit = min(max_depth, (SATURATED - 0.5) / units_per_meter)
    return cv2.threshold(depth_m, limit, 0.0, cv2.THRESH_TOZERO_INV, dst=depth_m)[1]


def image_size(path: Path) -> Size:
    """Stored width and height from the header of an image, without decoding. Raises FrameError."""
    try:
        return read_image_size(path)
    except ImageFileError as error:
        raise FrameError(str(error)) from error


def _decode(path: Path, flags: int, size: Size | None) -> NDArray[Any]:
    try:
        return read_image(path, flags, size)
    except WrongSizeError as error:
        raise FrameError(
            f"{path} has {error.found[0]} x {error.found[1]} pixels, but other frames have {error.expected[0]} x "
            f"{error.expected[1]}."
        ) from error
    except ImageFileError as error:
        raise FrameError(str(error)) from error


def _kind(image: NDArray[np.generic]) -> str:
    channels = 1 if image.ndim == 2 else image.shape[2]
    return f"{8 * image.itemsize}-bit with {channels} channel{'s' if channels > 1 else ''}"
