"""Writes an answer as one self-contained HTML file: regions, the map with them, and what the camera saw."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from .. import __version__
from ..core.atomic_files import write_whole
from ..core.errors import DependencyError
from ..query.best_views import RegionView
from ..query.scan_map import Map
from ..query.word_query import QueryResult
from .map_pictures import draw_query
from .palette import HIGHLIGHTS

_CROP = 320, 240
"""Greatest width and height of a crop, pixels."""
_MARGIN = 0.25  # share of a box that a crop shows on each side of it
_QUALITY = 85


def write_query_page(scan_map: Map, results: Sequence[QueryResult], path: str | Path, overwrite: bool = False) -> None:
    """Writes the page. The same answer gives the same page. If the map cannot be drawn, the page says why.

    Raises ExportError: an empty map, the file exists or cannot be written; MapError for a broken keyframe.
    """
    page = _page(scan_map, results)
    write_whole(Path(path), lambda target: _write_text(target, page), overwrite)


def _write_text(path: Path, text: str) -> None:
    path.write_text(text, encoding="utf-8")


def _page(scan_map: Map, results: Sequence[QueryResult]) -> str:
    from jinja2 import Environment, PackageLoader, StrictUndefined

    environment = Environment(
        loader=PackageLoader("freeocc3d", "viewer"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    try:
        picture, why = _data("png", draw_query(scan_map, results)), ""
    except DependencyError as error:
        picture, why = "", str(error)
    regions = [region for result in results for region in result.regions]
    views = scan_map.views_of_each(regions)
    stands = scan_map.stands_of(regions)
    boxes = scan_map.boxes_of(regions)
    row_of = {int(frame): row for row, frame in enumerate(scan_map.trajectory.keyframes)}
    answers, at = [], 0
    for number, result in enumerate(results):
        color = tuple(HIGHLIGHTS[number % len(HIGHLIGHTS)].tolist())
        rows = []
        for region in result.regions:
            crops = [
                {"view": view, "image": _crop(scan_map.keyframes[row_of[view.frame]].color, view, color)}
                for view in views[at]
            ]
            rows.append({"region": region, "stand": stands[at], "box": boxes[at], "crops": crops})
            at += 1
        answers.append({"result": result, "color": f"rgb({', '.join(map(str, color))})", "rows": rows})
    return environment.get_template("page.html").render(
        version=__version__, name=str(scan_map.path), answers=answers, picture=picture, why=why, metric=scan_map.metric
    )


def _crop(image: NDArray[np.uint8], view: RegionView, color: tuple[int, ...]) -> str:
    """Returns the box of a view with its surroundings, as the source of an <img>."""
    height, width = image.shape[:2]
    x0, y0, x1, y1 = view.box
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
    return _data("jpeg", encoded.tobytes())


def _data(kind: str, image: bytes) -> str:
    return f"data:image/{kind};base64,{base64.b64encode(image).decode()}"
