"""The parts of pages that need no other file: templates that escape what they show, and embedded images."""

from __future__ import annotations

import base64
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.atomic_files import write_whole
from ..query.best_views import RegionView

if TYPE_CHECKING:
    from jinja2 import Environment

_CROP = 320, 240
"""Greatest width and height of a crop, pixels."""
_MARGIN = 0.25  # share of a box that a crop shows on each side of it
_QUALITY = 85


def make_environment(room: str) -> Environment:
    """Returns what fills the templates of a folder of the package: it escapes special characters of values, and raises
    an error for a value that is missing."""
    from jinja2 import Environment, PackageLoader, StrictUndefined

    return Environment(
        loader=PackageLoader("freeocc3d", room),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )


def fill_template(template: str, /, **values: Any) -> str:
    """Returns the text of a template of this folder, with values whose special characters are escaped."""
    return make_environment("viewer").get_template(template).render(**values)


def write_page(path: Path, text: str, overwrite: bool) -> None:
    """Writes a page. Raises ExportError: the file exists, or cannot be written."""

    def write(target: Path) -> None:
        target.write_text(text, encoding="utf-8")

    write_whole(path, write, overwrite)


def crop_view(image: NDArray[np.uint8], view: RegionView, color: tuple[int, ...]) -> str:
    """Returns the box of a view with its surroundings, as the source of an <img>."""
    height, width = image.shape[:2]
    x0, y0, x1, y1 = np.minimum(view.box, (width - 1, height - 1) * 2).tolist()  # a map states boxes of objects
    around_x, around_y = (int(_MARGIN * (high + 1 - low)) + 8 for low, high in ((x0, x1), (y0, y1)))
    left, top = max(x0 - around_x, 0), max(y0 - around_y, 0)
    right, bottom = min(x1 + around_x, width - 1), min(y1 + around_y, height - 1)
    crop = image[top : bottom + 1, left : right + 1]
    scale = min(_CROP[0] / crop.shape[1], _CROP[1] / crop.shape[0])
    size = max(1, round(scale * crop.shape[1])), max(1, round(scale * crop.shape[0]))
    drawn = cv2.resize(crop, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR)
    corners = [(round(scale * (x - left)), round(scale * (y - top))) for x, y in ((x0, y0), (x1 + 1, y1 + 1))]
    cv2.rectangle(drawn, corners[0], (corners[1][0] - 1, corners[1][1] - 1), color, 2)
    encoded = cv2.imencode(".jpg", drawn[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1]
    return embed_image("jpeg", encoded.tobytes())


def embed_image(kind: str, image: bytes) -> str:
    """Returns an image as the source of an <img>. kind: "png" or "jpeg"."""
    return f"data:image/{kind};base64,{base64.b64encode(image).decode()}"
