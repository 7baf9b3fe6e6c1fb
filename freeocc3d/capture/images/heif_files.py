"""Decodes HEIC, HEIF and AVIF images, as phones store photographs, with Pillow and libheif.

libheif turns an image as the file's boxes say, and its EXIF orientation is then without effect (ISO/IEC 23008-12,
6.5.10 and A.3); Pillow leaves AVIF as it is stored, and states the boxes' turn as the EXIF orientation.
"""

from __future__ import annotations

import functools
import warnings
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...core.errors import FrameError
from ...core.image_files import MOST_PIXELS
from ...core.regular_files import IMAGE_BYTES, open_regular

HEIF_FORMATS = ("HEIF", "AVIF")
"""Pillow's names of the formats."""


@functools.cache
def register_heif() -> None:
    """Let Pillow open HEIF files. Raises ImportError without pillow-heif."""
    import pillow_heif

    pillow_heif.register_heif_opener()


def read_heif(path: Path) -> NDArray[np.uint8]:
    """Read (H, W, 3) uint8 RGB, turned as libheif or Pillow turn it. The size is checked before decoding. Raises
    FrameError."""
    from PIL import Image

    register_heif()
    try:
        with open_regular(path, IMAGE_BYTES) as stream, warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with Image.open(stream, formats=HEIF_FORMATS) as image:
                if image.width * image.height > MOST_PIXELS:
                    raise FrameError(
                        f"{path} states {image.width} x {image.height} pixels, more than the {MOST_PIXELS / 1e6:.0f} "
                        "million that are read: reduce it."
                    )
                return np.array(image.convert("RGB"))
    except (OSError, ValueError, SyntaxError, RuntimeError, EOFError, MemoryError) as error:
        raise FrameError(f"{path} is not a readable image: {str(error) or type(error).__name__}.") from error
    except Image.DecompressionBombError as error:
        raise FrameError(f"{path} states too many pixels: reduce it.") from error
