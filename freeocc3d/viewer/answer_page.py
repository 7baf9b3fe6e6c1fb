"""Writes an answer as one self-contained HTML file: regions, the map with them, and what the camera saw."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from .. import __version__
from ..core.errors import DependencyError
from ..query.scan_map import Map
from ..query.word_query import QueryResult
from .map_pictures import draw_query
from .palette import word_colors
from .self_contained_pages import crop_view, embed_image, fill_template, write_page


def write_query_page(scan_map: Map, results: Sequence[QueryResult], path: str | Path, overwrite: bool = False) -> None:
    """Writes the page. The same answer gives the same page. If the map cannot be drawn, the page says why.

    Raises ExportError: an empty map, the file exists or cannot be written; MapError for a broken keyframe.
    """
    write_page(Path(path), _page(scan_map, results), overwrite)


def _page(scan_map: Map, results: Sequence[QueryResult]) -> str:
    try:
        picture, why = embed_image("png", draw_query(scan_map, results)), ""
    except DependencyError as error:
        picture, why = "", str(error)
    regions = [region for result in results for region in result.regions]
    views = scan_map.views_of_each(regions)
    stands = scan_map.stands_of(regions)
    boxes = scan_map.boxes_of(regions)
    row_of = {int(frame): row for row, frame in enumerate(scan_map.trajectory.keyframes)}
    answers, at = [], 0
    for result, chosen in zip(results, word_colors([result.regions for result in results]), strict=True):
        color = tuple(chosen.tolist())
        rows = []
        for region in result.regions:
            crops = [
                {"view": view, "image": crop_view(scan_map.keyframes[row_of[view.frame]].color, view, color)}
                for view in views[at]
            ]
            rows.append({"region": region, "stand": stands[at], "box": boxes[at], "crops": crops})
            at += 1
        answers.append({"result": result, "color": f"rgb({', '.join(map(str, color))})", "rows": rows})
    return fill_template(
        "page.html",
        version=__version__,
        name=str(scan_map.path),
        answers=answers,
        picture=picture,
        why=why,
        metric=scan_map.metric,
    )
