"""Decodes color and class images, and raises an error for incomplete files."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ...core.errors import FrameError
from ...core.image_files import (
    PNG_START,
    ImageFileError,
    Size,
    WrongSizeError,
    check_encoded,
    decode_bytes,
    read_image,
    read_image_size,
)
from ...core.regular_files import IMAGE_BYTES, open_regular
from ...core.sampling import spread_evenly


def read_color(path: Path, size: Size | None = None, bits: int = 16) -> NDArray[np.uint8]:
    """Read (H, W, 3) uint8 RGB as stored. The EXIF orientation is not applied, because depth and intrinsics ignore it.

    size: the (width, height) that it must have, if known.  bits: of 16-bit images, how many of them hold the color (see
    ``count_color_bits``). Raises FrameError if the file is missing, cut off, not an image, or of another size.
    """
    flags = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
    image = decode_image(path, flags if bits == 16 else flags | cv2.IMREAD_ANYDEPTH, size)
    if image.dtype == np.uint16:
        image = cv2.convertScaleAbs(image, alpha=255 / ((1 << bits) - 1))
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB, dst=image)


def count_color_bits(paths: Sequence[Path], samples: int = 5) -> int:
    """How many bits of 16-bit color images hold the color: some cameras store 10, 12 or 14. 16 for other images."""
    if not paths or not _has_16_bits(paths[0]):
        return 16
    largest = 0
    for row in spread_evenly(len(paths), samples):
        try:
            image = decode_image(paths[row], cv2.IMREAD_UNCHANGED)
        except FrameError:
            continue
        largest = max(largest, int(image.max()) if image.dtype == np.uint16 else 1 << 16)
    return next((bits for bits in (10, 12, 14) if 0 < largest < 1 << bits), 16)


def _has_16_bits(path: Path) -> bool:
    """Whether a PNG states 16 bits per channel, or a TIFF decodes to them."""
    try:
        with open_regular(path, IMAGE_BYTES) as stream:
            head = stream.read(32)
        if head.startswith(PNG_START):
            return head[24:25] == b"\x10"
        return head[:2] in (b"II", b"MM") and decode_image(path, cv2.IMREAD_UNCHANGED).dtype == np.uint16
    except (OSError, FrameError):
        return False


def read_classes(path: Path, count: int, size: Size | None = None) -> NDArray[np.uint8]:
    """Read an (H, W) class image with values below ``count``. Many programs write 255 for "nothing"; it becomes 0
    unless it has a name. Raises FrameError as ``read_color`` does, also for a value without a class."""
    image = decode_image(path, cv2.IMREAD_UNCHANGED, size)
    if image.ndim != 2 or image.dtype not in (np.uint8, np.uint16):
        raise FrameError(f"{path} is not a class image: expected 8- or 16-bit gray, got {describe(image)}.")
    if count <= 255:
        image[image == 255] = 0
    if (largest := int(image.max())) >= count:
        raise FrameError(f"{path} holds class {largest}, but only {count} classes have names (0…{count - 1}).")
    return image.astype(np.uint8, copy=False)


def image_size(path: Path) -> Size:
    """Stored width and height from the header of an image, without decoding. Raises FrameError."""
    try:
        return read_image_size(path)
    except ImageFileError as error:
        raise FrameError(str(error)) from error


def decode_image(path: Path, flags: int, size: Size | None = None) -> NDArray[Any]:
    """Decode an image as ``cv2.imread`` does, with its flags. size: that it must have, if known. Raises FrameError."""
    with _as_frame_errors():
        return read_image(path, flags, size)


def decode_image_bytes(data: bytes, source: Path, flags: int, size: Size | None = None) -> NDArray[Any]:
    """Decode the bytes of an image file, as ``decode_image`` does. source: what they are, for messages."""
    with _as_frame_errors():
        return decode_bytes(data, source, flags, size)


def decode_color_bytes(data: bytes, source: Path, size: Size | None = None) -> NDArray[np.uint8]:
    """Decode the bytes of a color image to (H, W, 3) RGB, as ``read_color`` does. Raises FrameError."""
    image = decode_image_bytes(data, source, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION, size)
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB, dst=image)


def encoded_size(data: bytes, source: Path) -> Size:
    """Width and height of an encoded image, from its bytes. Raises FrameError."""
    with _as_frame_errors():
        return check_encoded(data, source)


@contextlib.contextmanager
def _as_frame_errors() -> Iterator[None]:
    try:
        yield
    except WrongSizeError as error:
        raise FrameError(
            f"{error.source} has {error.found[0]} x {error.found[1]} pixels, but other frames have "
            f"{error.expected[0]} x {error.expected[1]}."
        ) from error
    except ImageFileError as error:
        raise FrameError(str(error)) from error


def describe(image: NDArray[Any]) -> str:
    """The kind of an image in words, such as "8-bit with 3 channels"."""
    channels = 1 if image.ndim == 2 else image.shape[-1]
    return f"{8 * image.itemsize}-bit with {channels} channel{'s' if channels > 1 else ''}"
