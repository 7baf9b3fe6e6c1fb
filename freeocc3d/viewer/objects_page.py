"""Writes the objects of a map as one self-contained HTML file: a plan, and what the camera saw of each."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from .. import __version__
from ..query.objects.object import Object
from ..query.objects.relations import Relation
from ..query.scan_map import Map
from .distinct_colors import distinct_colors
from .object_pictures import draw_objects
from .self_contained_pages import crop_view, embed_image, fill_template, write_page

MOST_IMAGES = 300
"""Most images of objects on a page, which keep it below some 10 MB; further objects are listed without one."""


def write_objects_page(
    scan_map: Map,
    objects: Sequence[Object],
    relations: Sequence[Sequence[Relation]],
    shown: Sequence[int],
    path: Path,
    overwrite: bool = False,
) -> None:
    """Writes the page. The same objects give the same page. shown: rows of the objects on it; relations may name
    others.

    Raises ExportError: an empty map, the file exists or cannot be written; MapError for a broken keyframe.
    """
    page = _page(scan_map, objects, relations, shown)
    write_page(path, page, overwrite)


def _page(
    scan_map: Map, objects: Sequence[Object], relations: Sequence[Sequence[Relation]], shown: Sequence[int]
) -> str:
    colors = distinct_colors(len(objects)).tolist()
    images = _images(scan_map, objects, shown, colors)
    cards: list[dict[str, Any]] = [
        {
            "number": row + 1,
            "object": objects[row],
            "color": f"rgb({', '.join(map(str, colors[row]))})",
            "image": images.get(row, ""),
            "relations": [
                {
                    "text": f"{relation.kind} {'a wall' if relation.other is None else objects[relation.other].name}",
                    "number": None if relation.other is None else relation.other + 1,
                    "linked": relation.other in set(shown),
                    "gap": relation.gap_m,
                }
                for relation in relations[row]
            ],
        }
        for row in shown
    ]
    return fill_template(
        "objects.html",
        version=__version__,
        name=str(scan_map.path),
        plan=embed_image("png", draw_objects(scan_map, objects, shown)),
        cards=cards,
        count=len(objects),
        most=MOST_IMAGES,
        unit="m" if scan_map.metric else "units",
        metric=scan_map.metric,
    )


def _images(scan_map: Map, objects: Sequence[Object], shown: Sequence[int], colors: list[list[int]]) -> dict[int, str]:
    """Returns the source of an image for each of the first objects that a keyframe shows; decodes a keyframe once."""
    row_of = {int(frame): row for row, frame in enumerate(scan_map.trajectory.keyframes)}
    seen = [row for row in shown if objects[row].keyframes][:MOST_IMAGES]
    images: dict[int, str] = {}
    for frame in sorted({objects[row].keyframes[0].frame for row in seen}):
        color = scan_map.keyframes[row_of[frame]].color
        for row in seen:
            if objects[row].keyframes[0].frame == frame:
                images[row] = crop_view(color, objects[row].keyframes[0], tuple(colors[row]))
    return images
