"""Reads the headers of images: size, and what EXIF data state, without decoding.

Source: CIPA DC-008 (EXIF).
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..core.image_files import MOST_PIXELS, Size
from ..core.regular_files import IMAGE_BYTES, open_regular
from ..core.sampling import spread_evenly
from ..core.types import Intrinsics
from .cameras.camera_files import DIAGONAL_35MM, convert_35mm
from .cameras.lenses import Lens
from .images.heif_files import HEIF_FORMATS, register_heif

if TYPE_CHECKING:
    from PIL import Image

SAME_LENS = 0.05
"""Largest relative spread of the stated focal lengths of images from one lens."""

_SAMPLES = 3
_FORMATS = ("JPEG", "PNG", "TIFF", "BMP", "WEBP", *HEIF_FORMATS)
_EXIF, _ORIENTATION, _FOCAL, _FOCAL_35MM = 0x8769, 0x0112, 0x920A, 0xA405
_TIME, _SUBSECONDS, _WIDTH, _PLANE_RESOLUTION, _PLANE_UNIT = 0x9003, 0x9291, 0xA002, 0xA20E, 0xA210
_UNIT_MM = {2: 25.4, 3: 10.0, 4: 1.0}


@dataclass(frozen=True)
class Header:
    """The header of an image. size: upright.  orientation: EXIF's, 1…8.  focal: over the diagonal, or None.
    time: seconds, or None.  heif: whether it is HEIF or AVIF by its content.  by_decoder: whether decoding turns it
    upright."""

    size: Size
    orientation: int
    focal: float | None
    time: float | None
    heif: bool = False
    by_decoder: bool = False


def read_header(path: Path) -> Header | None:
    """Size and EXIF data of an image, without decoding it; None if the file is not an image that can be decoded."""
    from PIL import Image

    try:
        with open_regular(path, IMAGE_BYTES) as stream, warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of large images and damaged EXIF data
            register_heif()
            with Image.open(stream, formats=_FORMATS) as image:
                width, height = image.size
                exif, inner = _exif(image)
                heif, turned = image.format in HEIF_FORMATS, image.info.get("original_orientation")
    except (OSError, ValueError, SyntaxError, RuntimeError, EOFError, Image.DecompressionBombError):
        return None
    if width * height > MOST_PIXELS:
        return None
    orientation = exif.get(_ORIENTATION, 1)
    orientation = orientation if orientation in range(1, 9) else 1
    size = (height, width) if orientation >= 5 else (width, height)
    focal, time = _stated_focal(inner, width, height), _stated_time(inner)
    if isinstance(turned, int) and 2 <= turned <= 8:
        return Header(size, turned, focal, time, heif, by_decoder=True)
    return Header(size, orientation, focal, time, heif)


def _exif(image: Image.Image) -> tuple[Mapping[int, Any], Mapping[int, Any]]:
    """The EXIF data of an image and of its inner directory; empty if they are damaged, for which Pillow's parsers have
    errors of every type. Those behind the pixels of a PNG are left out, because Pillow decodes the pixels for them."""
    from PIL import Image

    try:
        exif = Image.Image.getexif(image) if image.format == "PNG" else image.getexif()
        return dict(exif), dict(exif.get_ifd(_EXIF))
    except Exception:
        return {}, {}


def find_common_lens(headers: Sequence[Header], size: Size) -> Intrinsics | None:
    """The camera of the lens that most images state; None if they state no lens, or several."""
    stated = [header.focal for header in headers if header.focal is not None]
    if 2 * len(stated) <= len(headers):
        return None
    low, middle, high = np.percentile(stated, (10, 50, 90))
    return None if high - low > SAME_LENS * middle else convert_35mm(float(middle) * DIAGONAL_35MM, size)


def read_rough_lens(paths: Sequence[Path], size: Size) -> Lens | None:
    """The lens whose focal length the EXIF data of a few images of ``size`` state; None if they state none, or several.
    It is accurate to a few percent."""
    rows = spread_evenly(len(paths), _SAMPLES)
    headers = [header for row in rows if (header := read_header(paths[row])) is not None]
    camera = find_common_lens(headers, size)
    return None if camera is None else Lens(camera)


def _stated_focal(exif: Any, width: int, height: int) -> float | None:
    """Stated focal length over the image diagonal, or None."""
    try:
        if exif.get(_FOCAL_35MM) and (camera := convert_35mm(float(exif[_FOCAL_35MM]), (width, height))):
            return camera.fx / float(np.hypot(width, height))
        pixels_per_mm = float(exif[_PLANE_RESOLUTION]) / _UNIT_MM[int(exif.get(_PLANE_UNIT, 2))]
        focal = float(exif[_FOCAL]) * pixels_per_mm * width / float(exif.get(_WIDTH, width))
    except (KeyError, TypeError, ValueError, ArithmeticError):
        return None
    # Wrong values are common: many programs change the image but keep the tag.
    return focal / float(np.hypot(width, height)) if 0.3 < focal / max(width, height) < 20 else None


def _stated_time(exif: Any) -> float | None:
    try:
        whole = datetime.strptime(str(exif[_TIME]).strip("\0 "), "%Y:%m:%d %H:%M:%S")
        digits = str(exif.get(_SUBSECONDS, "")).strip("\0 ")
        return (whole - datetime(1970, 1, 1)).total_seconds() + (float(f"0.{digits}") if digits.isdigit() else 0.0)
    except (KeyError, ValueError):
        return None
