"""Decodes the images of ROS messages: raw, compressed (JPEG, PNG) and compressedDepth (PNG, RVL).

Sources: sensor_msgs/Image and image_encodings.hpp, image_transport_plugins (compressed_image_transport,
compressed_depth_image_transport), A. D. Wilson, Fast Lossless Depth Image Compression, ISS 2017 (RVL).
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ...core.errors import FrameError
from ...core.image_files import MOST_PIXELS, Size
from ..images.depth_decoding import RawDepth
from ..images.image_decoding import decode_color_bytes, decode_image_bytes, describe, encoded_size

DEPTH_ENCODINGS = ("16UC1", "32FC1")
"""Encodings that are depth: integers of a millimeter, floats of a meter."""

INTEGER_DEPTH = "mono16"
"""Depth if its topic says so; otherwise infrared."""

_CHANNELS: dict[str, tuple[int, int | None]] = {
    "rgb8": (3, None), "bgr8": (3, cv2.COLOR_BGR2RGB), "8uc3": (3, cv2.COLOR_BGR2RGB),
    "rgba8": (4, cv2.COLOR_RGBA2RGB), "bgra8": (4, cv2.COLOR_BGRA2RGB), "8uc4": (4, cv2.COLOR_BGRA2RGB),
    "mono8": (1, cv2.COLOR_GRAY2RGB), "8uc1": (1, cv2.COLOR_GRAY2RGB),
    "bayer_rggb8": (1, cv2.COLOR_BayerBG2RGB), "bayer_bggr8": (1, cv2.COLOR_BayerRG2RGB),
    "bayer_gbrg8": (1, cv2.COLOR_BayerGR2RGB), "bayer_grbg8": (1, cv2.COLOR_BayerGB2RGB),
    "yuv422": (2, cv2.COLOR_YUV2RGB_UYVY), "uyvy": (2, cv2.COLOR_YUV2RGB_UYVY),
    "yuv422_yuy2": (2, cv2.COLOR_YUV2RGB_YUY2), "yuyv": (2, cv2.COLOR_YUV2RGB_YUY2),
}  # fmt: skip
"""Encoding in small letters -> bytes per pixel and OpenCV's conversion to RGB. OpenCV names a Bayer pattern after its
second row."""

GRAY_ENCODINGS = ("mono8", "8uc1")

_DEPTH_HEADER = struct.Struct("<iff")  # of compressedDepth: its form, and the two parameters of inverse depth


@dataclass(frozen=True)
class ImageKind:
    """What an image message holds. encoding: of the image that was sent, before compression. form: "raw", "image"
    (JPEG or PNG) or "depth" (compressedDepth).  frame_id: without a leading "/".
    """

    encoding: str
    form: str
    size: Size
    frame_id: str

    @property
    def is_color(self) -> bool:
        """Whether it can be decoded as color."""
        if self.form == "image":
            return self.encoding not in (*DEPTH_ENCODINGS, INTEGER_DEPTH)
        return self.form == "raw" and self.encoding.lower() in _CHANNELS

    @property
    def is_gray(self) -> bool:
        """Whether it has no colors."""
        return self.encoding.lower() in GRAY_ENCODINGS

    def is_depth(self, topic: str) -> bool:
        """Whether it can be decoded as depth."""
        return self.encoding in DEPTH_ENCODINGS or (self.encoding == INTEGER_DEPTH and "depth" in topic.lower())


def describe_image(message: Any, what: str) -> ImageKind:
    """What an Image or CompressedImage is. what: the message in words. Raises FrameError if it is damaged."""
    frame_id = str(message.header.frame_id).lstrip("/")
    if hasattr(message, "encoding"):
        return ImageKind(str(message.encoding), "raw", (int(message.width), int(message.height)), frame_id)
    encoding, _, how = (part.strip() for part in str(message.format).partition(";"))
    data = _data(message)
    if "compresseddepth" in how.lower().replace("_", "") or "compresseddepth" in encoding.lower():
        encoding = encoding if encoding in DEPTH_ENCODINGS else DEPTH_ENCODINGS[0]
        return ImageKind(encoding, "depth", _depth_size(data, how, what), frame_id)
    return ImageKind(encoding if how else "", "image", encoded_size(data, Path(what)), frame_id)


def decode_color(message: Any, what: str) -> NDArray[np.uint8]:
    """(H, W, 3) RGB. what: the message in words. Raises FrameError."""
    if not hasattr(message, "encoding"):
        return decode_color_bytes(_data(message), Path(what))
    encoding = str(message.encoding).lower()
    if encoding not in _CHANNELS:
        raise FrameError(f"{what} has the encoding {message.encoding}, which is not read as color.")
    channels, conversion = _CHANNELS[encoding]
    rows = _rows(message, channels, what)
    if rows.shape[0] < 2 or rows.shape[1] < 2 or (channels == 2 and rows.shape[1] % 2):
        raise FrameError(f"{what} has an image of {rows.shape[1]} x {rows.shape[0]} pixels, which is not possible.")
    plain = np.ascontiguousarray(rows[..., 0] if channels == 1 else rows)
    return plain.copy() if conversion is None else cv2.cvtColor(plain, conversion)


def decode_depth(message: Any, what: str) -> RawDepth:
    """(H, W) depth: uint16 as stored, or float32 meters; it may be a view of the message. Raises FrameError."""
    if hasattr(message, "encoding"):
        kind = np.dtype(np.float32 if message.encoding == "32FC1" else np.uint16)
        rows = np.ascontiguousarray(_rows(message, kind.itemsize, what)).reshape(int(message.height), -1)
        return rows.view(kind.newbyteorder(">" if message.is_bigendian else "<")).astype(kind, copy=False)
    sent, data = describe_image(message, what), _data(message)
    if sent.form == "image":
        return _decode_gray16(data, what)
    if len(data) < _DEPTH_HEADER.size:
        raise FrameError(f"{what} is cut off.")
    _, a, b = _DEPTH_HEADER.unpack_from(data)
    packed = data[_DEPTH_HEADER.size :]
    stored = _decode_rvl_message(packed, what) if _is_rvl(message.format) else _decode_gray16(packed, what)
    if sent.encoding == "16UC1":
        return stored
    with np.errstate(divide="ignore", invalid="ignore"):  # inverse depth, 0 = none
        return np.where(stored > 0, a / (stored.astype(np.float32) - b), 0).astype(np.float32)


def _data(message: Any) -> bytes:
    return bytes(memoryview(message.data))


def _rows(message: Any, channels: int, what: str) -> NDArray[np.uint8]:
    """(H, W, channels) bytes of a raw image, which may pad its rows. Raises FrameError."""
    width, height, step = int(message.width), int(message.height), int(message.step)
    data = np.frombuffer(memoryview(message.data), np.uint8)
    step = step or width * channels
    if not 0 < width * height <= MOST_PIXELS or step < width * channels:
        raise FrameError(f"{what} states {width} x {height} pixels in rows of {step} bytes, which is not possible.")
    if len(data) < step * (height - 1) + width * channels:
        raise FrameError(f"{what} is cut off: it has {len(data)} bytes for {width} x {height} pixels.")
    whole = np.zeros(step * height, np.uint8) if len(data) < step * height else data[: step * height]
    if len(data) < step * height:
        whole[: len(data)] = data
    return whole.reshape(height, step)[:, : width * channels].reshape(height, width, channels)


def _decode_gray16(data: bytes, what: str) -> NDArray[np.uint16]:
    image = decode_image_bytes(data, Path(what), cv2.IMREAD_UNCHANGED)
    if image.ndim != 2 or image.dtype != np.uint16:
        raise FrameError(f"{what} is not depth: expected 16-bit gray, got {describe(image)}.")
    return image


def _is_rvl(form: str) -> bool:
    return "rvl" in form.lower()


def _depth_size(data: bytes, how: str, what: str) -> Size:
    """The size that compressed depth states. Raises FrameError."""
    packed = data[_DEPTH_HEADER.size :]
    if not _is_rvl(how):
        return encoded_size(packed, Path(what))
    if len(packed) < 8:
        raise FrameError(f"{what} is cut off.")
    width, height = struct.unpack_from("<II", packed)
    if not 0 < width * height <= MOST_PIXELS:
        raise FrameError(f"{what} states {width} x {height} pixels, which is not possible.")
    return width, height


def _decode_rvl_message(packed: bytes, what: str) -> NDArray[np.uint16]:
    """RVL with its columns and rows in front, 32 bits each. Raises FrameError."""
    from .rvl import decode_rvl  # imports Numba, which opening a capture must not

    width, height = _depth_size(bytes(_DEPTH_HEADER.size) + packed, "rvl", what)
    found = decode_rvl(packed[8:], width * height)
    if found is None:
        raise FrameError(f"{what} is cut off or damaged (RVL, {len(packed)} bytes).")
    return found.reshape(height, width)
