"""Reads encoded images from outside: PNG, JPEG, TIFF, BMP and WebP. A decoder sees a file only after its header is
checked, so that neither a device nor a small file of a huge image can fill the memory or stop the program.

Sources: ISO/IEC 15948 (PNG), ITU T.81 (JPEG), TIFF 6.0 and BigTIFF, Microsoft's BITMAPINFOHEADER, RFC 9649 (WebP).
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .regular_files import IMAGE_BYTES, read_bytes

Size = tuple[int, int]
"""Width and height in pixels."""

MOST_PIXELS = 100_000_000
"""Largest image that is decoded. With what its decoder and its conversion copy, it takes 1 to 1.8 GB."""

JPEG_START, JPEG_END = b"\xff\xd8", b"\xff\xd9"
PNG_START, PNG_END = b"\x89PNG\r\n\x1a\n", b"IEND\xaeB`\x82"
TAIL_BYTES = 4096
"""The end marker may stand this many bytes before the end, because cameras may append bytes to it."""

_SCANS = 256
"""Most scans of a JPEG. A decoder passes through the whole image for each; encoders write about 10."""


class ImageFileError(ValueError):
    """An image file cannot be read, or must not be decoded. The message is a sentence with the file's name."""


class WrongSizeError(ImageFileError):
    """An image has another size than the expected one. source: the image.  found, expected: the two sizes."""

    def __init__(self, path: Path, found: Size, expected: Size):
        super().__init__(f"{path} has {found[0]} x {found[1]} pixels, not {expected[0]} x {expected[1]}.")
        self.source, self.found, self.expected = path, found, expected


def read_image(path: Path, flags: int, size: Size | None = None, most_pixels: int = MOST_PIXELS) -> NDArray[Any]:
    """Decode an image as ``cv2.imread`` does, with its flags: (H, W) or (H, W, channels), BGR.

    size: the stored size that the image must have; None = any of at most ``most_pixels``. Raises WrongSizeError, before
    decoding, for another size; ImageFileError for no regular file, another format, too many pixels, or a file that is
    cut off or damaged.
    """
    return decode_bytes(_read(path), path, flags, size, most_pixels)


def decode_bytes(
    data: bytes, source: Path, flags: int, size: Size | None = None, most_pixels: int = MOST_PIXELS
) -> NDArray[Any]:
    """Decode the bytes of an image file, as ``read_image`` does. source: what they are, for messages, such as a file
    and a member of it."""
    import cv2

    check_encoded(data, source, size, most_pixels)
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except (cv2.error, MemoryError):
        image = None
    if image is None:
        raise _unreadable(source, data)
    if size is not None and image.shape[1::-1] != size:
        raise WrongSizeError(source, image.shape[1::-1], size)
    return image


def check_encoded(data: bytes, path: Path, size: Size | None = None, most_pixels: int = MOST_PIXELS) -> Size:
    """Check the header and the end of an encoded image, and return its size. Raises ImageFileError."""
    width, height = found = _checked_size(path, data, most_pixels)
    if size is not None and found != size:
        raise WrongSizeError(path, found, size)
    tail = data[-TAIL_BYTES:]
    if (data.startswith(JPEG_START) and JPEG_END not in tail) or (data.startswith(PNG_START) and PNG_END not in tail):
        raise ImageFileError(f"{path} is cut off: its end is missing ({len(data)} bytes).")
    if data.startswith(PNG_START) and not _chunks_fit(data):
        raise _unreadable(path, data)
    if data.startswith(JPEG_START) and width * height > len(data) and data.count(b"\xff\xda") > _SCANS:
        raise ImageFileError(f"{path} is a JPEG image of more than {_SCANS} scans: save it anew.")
    return found


def read_image_size(path: Path, most_pixels: int = MOST_PIXELS) -> Size:
    """Width and height as stored, from the header, without decoding. Raises ImageFileError."""
    return _checked_size(path, _read(path), most_pixels)


def _read(path: Path) -> bytes:
    try:
        return read_bytes(path, IMAGE_BYTES)
    except OSError as error:
        raise ImageFileError(f"Cannot read {path}: {error.strerror}.") from error


def _checked_size(path: Path, data: bytes, most_pixels: int) -> Size:
    try:
        size = _stated_size(data)
    except (struct.error, IndexError):  # the header is cut off
        size = None
    if size is None or min(size) <= 0:
        raise _unreadable(path, data)
    if size[0] * size[1] > most_pixels:
        raise ImageFileError(
            f"{path} states {size[0]} x {size[1]} pixels, more than the {most_pixels / 1e6:.0f} million that are read: "
            "reduce it."
        )
    return size


def _unreadable(path: Path, data: bytes) -> ImageFileError:
    return ImageFileError(f"{path} is not a readable image: expected PNG, JPEG, TIFF, BMP or WebP ({len(data)} bytes).")


def _stated_size(data: bytes) -> Size | None:
    """The size that the header states; None for another format. Raises struct.error, IndexError if it is cut off."""
    if data.startswith(JPEG_START):
        return _jpeg_size(data)
    if data.startswith(PNG_START):
        return struct.unpack_from(">II", data, 16) if data[12:16] == b"IHDR" else None
    if data.startswith(b"RIFF") and data[8:12] == b"WEBP":
        return _webp_size(data)
    if data[:4] in (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"):
        return _tiff_size(data)
    if data.startswith(b"BM"):
        form = "<HH" if struct.unpack_from("<I", data, 14)[0] == 12 else "<ii"
        width, height = struct.unpack_from(form, data, 18)
        return width, abs(height)  # negative: from the top down
    return None


def _chunks_fit(data: bytes) -> bool:
    """Whether the chunks of a PNG follow one another to its end; OpenCV takes memory for whatever length one states."""
    at = 8
    while data[at + 4 : at + 8] != b"IEND":
        at += 12 + int.from_bytes(data[at : at + 4], "big")
        if at + 12 > len(data):
            return False
    return True


def _jpeg_size(data: bytes) -> Size | None:
    """Size from the start-of-frame segment (ITU T.81, B.2.2). As decoders do, skips bytes between segments."""
    at = 2
    while (at := data.find(b"\xff", at)) >= 0:
        marker = data[at + 1]
        if marker == 0xFF:  # a fill byte
            at += 1
        elif marker in (0x00, 0x01) or 0xD0 <= marker <= 0xD7:  # without a length
            at += 2
        elif 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            height, width = struct.unpack_from(">HH", data, at + 5)
            return width, height
        elif marker in (0xD8, 0xD9, 0xDA):  # another start, the end, or a scan without a frame
            return None
        else:
            at += 2 + int.from_bytes(data[at + 2 : at + 4], "big")
    return None


def _webp_size(data: bytes) -> Size | None:
    if data[12:16] == b"VP8X":
        return 1 + int.from_bytes(data[24:27], "little"), 1 + int.from_bytes(data[27:30], "little")
    if data[12:16] == b"VP8L":
        bits = struct.unpack_from("<I", data, 21)[0]
        return 1 + (bits & 0x3FFF), 1 + (bits >> 14 & 0x3FFF)
    if data[12:16] == b"VP8 ":
        width, height = struct.unpack_from("<HH", data, 26)
        return width & 0x3FFF, height & 0x3FFF
    return None


_TIFF_WIDTH, _TIFF_HEIGHT, _TIFF_TILE_WIDTH, _TIFF_TILE_HEIGHT = 256, 257, 322, 323


def _tiff_size(data: bytes) -> Size | None:
    """Size of the first image; that of a tile if it is larger, because decoders take memory for a whole tile."""
    order = "<" if data.startswith(b"II") else ">"
    big = 0x2B in data[2:4]
    at = struct.unpack_from(order + ("Q" if big else "I"), data, 8 if big else 4)[0]
    if at >= len(data):
        return None
    count, step = struct.unpack_from(order + ("Q" if big else "H"), data, at)[0], 20 if big else 12
    at += 8 if big else 2
    sides = dict.fromkeys((_TIFF_WIDTH, _TIFF_HEIGHT, _TIFF_TILE_WIDTH, _TIFF_TILE_HEIGHT), 0)
    for entry in range(at, min(at + count * step, len(data) - step + 1), step):
        tag, kind = struct.unpack_from(order + "HH", data, entry)
        if tag in sides:
            form = {3: "H", 4: "I", 16: "Q"}.get(kind)
            if form is None:
                return None
            sides[tag] = max(sides[tag], *struct.unpack_from(order + form, data, entry + (12 if big else 8)))
    width, height, tile_width, tile_height = sides.values()
    if tile_width * tile_height > MOST_PIXELS:
        return tile_width, tile_height
    return width, height
