"""Decodes stored depth of every usual kind: 16-bit images (PNG, TIFF, PGM), and floats (TIFF, PFM, EXR, NPY, NPZ).

Sources: the Netpbm format pages (PGM), P. Debevec's description of PFM, OpenEXR's Python module, NumPy's format page.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from ...core import arrays
from ...core.errors import DependencyError, FrameError, MapError
from ...core.image_files import MOST_PIXELS, Size
from ...core.regular_files import IMAGE_BYTES, check_content, read_bytes
from ..files.image_suffixes import DEPTH_SUFFIXES
from .image_decoding import decode_image, describe, image_size

"""Suffixes of files that may hold depth."""

SATURATED = np.iinfo(np.uint16).max
"""The integer that sensors and renderers store for a depth that exceeds 16 bits."""

MILLIMETERS, METERS = 1000.0, 1.0
"""Units per meter of integers and of floats, unless something states others."""

RawDepth = NDArray[Any]
"""(H, W) depth as stored: uint16 of a unit that is stated elsewhere, or float32."""

_NETPBM = re.compile(rb"(P5|Pf)\s+(?:#[^\n]*\n\s*)*(\d{1,9})\s+(?:#[^\n]*\n\s*)*(\d{1,9})\s+(-?[0-9.eE+]{1,20})\s")
_LONGEST_HEADER = 4096
_MOST_NUMBERS = 2 * MOST_PIXELS  # in all channels of an EXR image: 0.8 GB
_Read = TypeVar("_Read")


def read_raw_depth(path: Path, size: Size | None = None) -> RawDepth:
    """Read (H, W) depth as stored. size: the (width, height) that it must have, if known.

    Raises FrameError if the file is missing, cut off, of another size, or holds no depth; DependencyError without the
    package that a kind needs.
    """
    suffix = path.suffix.lower()
    if suffix in (".npy", ".npz"):
        return _as_depth(_read_numpy(path), path, size)
    if suffix == ".exr":
        return _as_depth(_read_exr(path), path, size)
    if suffix in (".pgm", ".pfm"):
        return _as_depth(_read_netpbm(path), path, size)
    return _as_depth(decode_image(path, cv2.IMREAD_UNCHANGED, size), path, size)


def read_depth_size(path: Path) -> Size:
    """Width and height of stored depth; of images and EXR from the header alone. Raises what ``read_raw_depth``
    raises."""
    suffix = path.suffix.lower()
    if suffix == ".exr":
        return _exr_size(path)
    if suffix in DEPTH_SUFFIXES - {".png", ".tif", ".tiff"}:
        height, width = read_raw_depth(path).shape
        return width, height
    return image_size(path)


def convert_to_meters(raw: RawDepth, units_per_meter: float, max_depth: float) -> NDArray[np.float32]:
    """Convert stored depth to float32 meters. Saturated integers, floats that are no depth, and what lies beyond
    ``max_depth`` meters become 0."""
    depth_m, scale = raw.astype(np.float32), np.float32(1.0 / units_per_meter)
    limit = max_depth
    if raw.dtype == np.uint16:
        limit = min(max_depth, (SATURATED - 0.5) / units_per_meter)
    else:
        cv2.patchNaNs(depth_m, 0.0)
        cv2.threshold(depth_m, 0.0, 0.0, cv2.THRESH_TOZERO, dst=depth_m)  # what is below is no depth; infinity is far
    if scale != 1.0:
        depth_m *= scale
    return cv2.threshold(depth_m, limit, 0.0, cv2.THRESH_TOZERO_INV, dst=depth_m)[1]


def usual_units(raw: RawDepth) -> float:
    """Units per meter that integers or floats usually have."""
    return MILLIMETERS if raw.dtype == np.uint16 else METERS


def _as_depth(image: NDArray[Any], path: Path, size: Size | None) -> RawDepth:
    """An array of numbers as depth. Raises FrameError."""
    if image.ndim == 3 and 1 in (image.shape[0], image.shape[2]):
        image = image[..., 0] if image.shape[2] == 1 else image[0]
    if image.ndim != 2 or not image.size or image.dtype.kind not in "uif" or image.dtype == np.uint8:
        raise FrameError(f"{path} is not a depth image: expected 16-bit gray or floats, got {describe(image)}.")
    if size is not None and image.shape[::-1] != size:
        raise FrameError(
            f"{path} has {image.shape[1]} x {image.shape[0]} pixels, but other frames have {size[0]} x {size[1]}."
        )
    if image.dtype == np.uint16 or image.dtype.kind == "f":
        return np.ascontiguousarray(image, np.uint16 if image.dtype == np.uint16 else np.float32)
    return np.clip(image, 0, SATURATED).astype(np.uint16)


def _read_numpy(path: Path) -> NDArray[Any]:
    """The array of a file, or the one named depth, or the only one."""
    most = MOST_PIXELS * 8
    try:
        if path.suffix.lower() == ".npy":
            return arrays.read_array(path, most)
        found = arrays.read_arrays(path, {}, most_bytes=most)
    except MapError as error:
        raise FrameError(str(error)) from error
    if "depth" not in found and len(found) != 1:
        raise FrameError(f"{path} holds {len(found)} arrays, none of them named depth: keep only the depth.")
    return found["depth"] if "depth" in found else next(iter(found.values()))


def _read_netpbm(path: Path) -> NDArray[Any]:
    """A PGM of 16 bits (big-endian) or a gray PFM (rows from below; a negative scale means little-endian)."""
    try:
        data = read_bytes(path, IMAGE_BYTES)
    except OSError as error:
        raise FrameError(f"Cannot read {path}: {error.strerror}.") from error
    header = _NETPBM.match(data[:_LONGEST_HEADER])
    if header is None:
        raise FrameError(f"{path} is not a gray PGM or PFM image ({len(data)} bytes).")
    floats, width, height = header[1] == b"Pf", int(header[2]), int(header[3])
    try:
        scale = float(header[4])
    except ValueError:
        raise FrameError(f"{path} is not a gray PGM or PFM image ({len(data)} bytes).") from None
    kind = ("<f4" if scale < 0 else ">f4") if floats else ">u2" if scale > 255 else "u1"
    count = width * height
    if not 0 < count <= MOST_PIXELS or len(data) - header.end() < count * np.dtype(kind).itemsize:
        raise FrameError(f"{path} is cut off: it states {width} x {height} pixels, and holds {len(data)} bytes.")
    image = np.frombuffer(data, kind, count, header.end()).reshape(height, width)
    return image[::-1].astype(np.float32) if floats else image.astype(image.dtype.newbyteorder("="))


def _read_exr(path: Path) -> NDArray[Any]:
    """The channel Z or Y, or the first of equal ones, such as R of a gray image."""
    _exr_size(path)
    channels = _load_exr(path, lambda file: {name: channel.pixels for name, channel in file.channels().items()})
    name = next((name for name in ("Z", "Y", "V", "depth", "R", "RGB", "RGBA") if name in channels), None)
    if name is None:
        raise FrameError(f"{path} has no channel Z, Y or R: it has {', '.join(channels) or 'none'}.")
    pixels = channels[name]
    return np.asarray(pixels if pixels.ndim == 2 else pixels[..., 0])


def _exr_size(path: Path) -> Size:
    """Width and height by the header. Raises FrameError, also if the channels together would be too large."""

    def read(file: Any) -> tuple[int, int, int]:
        header = file.header()
        low, high = header["dataWindow"]
        return int(high[0]) - int(low[0]) + 1, int(high[1]) - int(low[1]) + 1, len(header["channels"])

    width, height, channels = _load_exr(path, read, header_only=True)
    if min(width, height) <= 0 or width * height * max(channels, 1) > _MOST_NUMBERS:
        raise FrameError(f"{path} states {width} x {height} pixels of {channels} channels, which is not possible.")
    return width, height


def _load_exr(path: Path, read: Callable[[Any], _Read], header_only: bool = False) -> _Read:
    """What ``read`` takes from an EXR file. Raises FrameError, DependencyError."""
    try:
        import OpenEXR
    except ImportError as error:
        raise DependencyError(f"{path} needs OpenEXR: run pip install 'freeocc3d[formats]'.") from error
    try:
        check_content(path, IMAGE_BYTES)
        return read(OpenEXR.File(str(path), header_only=header_only))
    except OSError as error:
        raise FrameError(f"Cannot read {path}: {error.strerror or 'it is not a readable EXR image'}.") from error
    except Exception as error:  # OpenEXR's own errors are of several types, also for a header without parts
        raise FrameError(f"{path} is not a readable EXR image: it is damaged, or of an unknown kind.") from error
