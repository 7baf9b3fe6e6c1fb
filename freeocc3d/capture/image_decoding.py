"""Decodes color, depth and class images (PNG, JPEG), and raises an error for incomplete files.

The end marker shows whether a file is complete: some decoders return the existing part of a cut-off JPEG, and gray for
the rest.
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.errors import FrameError

Size = tuple[int, int]
"""Width and height in pixels."""

JPEG_START, JPEG_END = b"\xff\xd8", b"\xff\xd9"
PNG_START, PNG_END = b"\x89PNG\r\n\x1a\n", b"IEND\xaeB`\x82"
TAIL_BYTES = 4096
"""The end marker may stand this many bytes before the end, because cameras may append bytes to it."""

SATURATED = np.iinfo(np.uint16).max
"""The value that sensors and renderers store for a depth that exceeds 16 bits."""


def read_color(path: Path) -> NDArray[np.uint8]:
    """Read (H, W, 3) uint8 RGB as stored. The EXIF orientation is not applied, because depth and intrinsics ignore it.

    Raises FrameError if the file is missing, cut off or not an image.
    """
    image = _decode(path, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB, dst=image)


def read_depth(path: Path) -> NDArray[np.uint16]:
    """Read (H, W) uint16 depth as stored. Raises FrameError, also for an image that is not 16-bit gray."""
    image = _decode(path, cv2.IMREAD_UNCHANGED)
    if image.ndim != 2 or image.dtype != np.uint16:
        raise FrameError(f"{path} is not a depth image: expected 16-bit gray, got {_kind(image)}.")
    return image


def read_classes(path: Path, count: int) -> NDArray[np.uint8]:
    """Read an (H, W) class image with values below ``count``. Many programs write 255 for "nothing"; it becomes 0
    unless it has a name. Raises FrameError, also for a value without a class."""
    image = _decode(path, cv2.IMREAD_UNCHANGED)
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
    """Width and height from the header of a PNG or JPEG, without decoding. Raises FrameError."""
    data = _read(path)
    if data.startswith(PNG_START) and len(data) >= 24:
        return struct.unpack(">II", data[16:24])
    if data.startswith(JPEG_START) and (size := _jpeg_size(data)):
        return size
    raise FrameError(f"{path} is not a PNG or JPEG image.")


def _decode(path: Path, flags: int) -> NDArray[Any]:
    data = _read(path)
    tail = data[-TAIL_BYTES:]
    if (data.startswith(JPEG_START) and JPEG_END not in tail) or (data.startswith(PNG_START) and PNG_END not in tail):
        raise FrameError(f"{path} is cut off: its end is missing ({len(data)} bytes).")
    image = cv2.imdecode(np.frombuffer(data, np.uint8), flags) if data else None
    if image is None:
        raise FrameError(f"{path} is not a readable image ({len(data)} bytes).")
    return image


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise FrameError(f"Cannot read {path}: {error.strerror}.") from error


def _jpeg_size(data: bytes) -> Size | None:
    """Size from the start-of-frame segment (ITU T.81, B.2.2), which follows segments of stated length."""
    at = 2
    while at + 9 <= len(data) and data[at] == 0xFF:
        marker = data[at + 1]
        if marker == 0xFF:  # a fill byte
            at += 1
            continue
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            height, width = struct.unpack(">HH", data[at + 5 : at + 9])
            return width, height
        at += 2 + int.from_bytes(data[at + 2 : at + 4], "big")
    return None


def _kind(image: NDArray[np.generic]) -> str:
    channels = 1 if image.ndim == 2 else image.shape[2]
    return f"{8 * image.itemsize}-bit with {channels} channel{'s' if channels > 1 else ''}"
