"""Draws the objects of a map from above, each in a color of its own, with its number."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.atomic_files import write_whole
from ..core.errors import ExportError
from ..core.transforms import transform
from ..query.objects.object import Object
from ..query.scan_map import Map
from .distinct_colors import distinct_colors
from .floor_plans import FloorPlan
from .lettering import HEADING, LEGEND, SMALL, measure_text, write_text
from .scene_rendering import BACKGROUND

SIZE = 1600, 960
"""Width and height of the picture, pixels."""

_PLAN, _BAR, _MARGIN, _ROW = 1180, 56, 30, 22  # width of the plan; the heading; around the plan; lines of the list
_FLOOR, _WALL = 236, 170  # gray of the lowest and the highest voxels of no object
_LABEL = (255, 255, 255)  # color behind a number
_CORNERS = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) / 2
_LONGEST_NAME = 22
_AROUND = ((0, 0), (0, -1), (0, 1), (1, 0), (-1, 0), (1, -1), (-1, 1), (1, 1), (-1, -1), (0, -2), (0, 2), (2, 0))
"""Places of a number that others leave no room at its object's middle, in sizes of the number."""


def write_objects_picture(
    scan_map: Map, objects: Sequence[Object], shown: Sequence[int], path: Path, overwrite: bool = False
) -> None:
    """Writes a PNG. shown: rows of the objects to draw. Raises ExportError: an empty map, another ending than .png, or
    an unwritable target."""
    if path.suffix.lower() != ".png":
        raise ExportError(f"Pictures are written as PNG: use the name {path.with_suffix('.png')} in place of {path}.")
    png = draw_objects(scan_map, objects, shown)

    def write(target: Path) -> None:
        target.write_bytes(png)

    write_whole(path, write, overwrite)


def draw_objects(scan_map: Map, objects: Sequence[Object], shown: Sequence[int]) -> bytes:
    """Returns the PNG that ``write_objects_picture`` writes: a plan, and a list of numbers, names and sizes."""
    if not len(scan_map.occupancy.colors):
        raise ExportError(f"The map {scan_map.path} has no occupied voxels to draw.")
    picture = np.full((SIZE[1], SIZE[0], 3), BACKGROUND, np.uint8)
    colors = distinct_colors(len(objects))
    _draw_plan(picture, scan_map, objects, shown, colors)
    name = Path(scan_map.manifest.capture.path).name
    count = f"{len(shown)} of {len(objects)}" if len(shown) < len(objects) else str(len(objects))
    write_text(picture, f"{name}: {count} objects from above", (16, 36), HEADING)
    room = (SIZE[1] - _BAR - _MARGIN) // _ROW
    listed = shown if len(shown) <= room else shown[: room - 1]
    for line, row in enumerate(listed):
        thing, y = objects[row], _BAR + 14 + line * _ROW
        cv2.rectangle(picture, (_PLAN, y - 12), (_PLAN + 14, y + 2), colors[row].tolist(), -1)
        size = " x ".join(f"{edge:.2f}" for edge in thing.box.extent)
        write_text(
            picture,
            f"{row + 1} {_shortened(thing.name)}, {size}{' m' if scan_map.metric else ''}",
            (_PLAN + 22, y),
            SMALL,
        )
    if len(listed) < len(shown):
        write_text(picture, f"and {len(shown) - len(listed)} more", (_PLAN + 22, _BAR + 14 + len(listed) * _ROW), SMALL)
    return bytes(cv2.imencode(".png", picture[..., ::-1])[1])


def _draw_plan(
    picture: NDArray[np.uint8],
    scan_map: Map,
    objects: Sequence[Object],
    shown: Sequence[int],
    colors: NDArray[np.uint8],
) -> None:
    """Draws the room pale, and the objects above it, the highest on top; things near the ceiling only as outlines."""
    plan = FloorPlan(scan_map, (0, _BAR, _PLAN - _MARGIN, SIZE[1]), _MARGIN)
    height = plan.heights
    level = (height - height.min()) / max(float(np.ptp(height)), 1e-9)
    pale = np.repeat((_FLOOR + (_WALL - _FLOOR) * level)[:, None], 3, axis=1).astype(np.uint8)
    plan.draw_voxels(picture, plan.drawn, pale[plan.drawn])
    below = np.zeros(len(height), bool)
    below[plan.drawn] = True
    tops = [float((thing.box.T_map_box[:3, 3] @ scan_map.up) + thing.box.extent[2] / 2) for thing in objects]
    order = sorted(shown, key=tops.__getitem__)
    for row in order:
        rows = objects[row].rows
        if below[rows].mean() > 0.5:
            shade = 0.75 * colors[row] + 0.25 * scan_map.occupancy.colors[rows]
            plan.draw_voxels(picture, rows, shade.astype(np.uint8))
    for row in order:
        box = objects[row].box
        corners = np.column_stack((_CORNERS * box.extent[:2], np.zeros(4)))
        outline = np.rint(8 * plan.pixel(transform(box.T_map_box, corners))).astype(np.int32)
        dark = (0.6 * colors[row]).tolist()
        cv2.polylines(picture, [outline], True, dark, 2, cv2.LINE_AA, shift=3)
    taken = np.zeros((0, 2, 2))
    for row in sorted(shown, key=lambda row: -len(objects[row].rows)):
        thing = objects[row]
        place, wide = plan.pixel(thing.centroid[None])[0], plan.scale * float(thing.box.extent[:2].max())
        texts = [f"{row + 1} {_shortened(thing.name)}", str(row + 1)]
        text = next((text for text in texts if _label_size(text)[0] <= wide), texts[1])
        label = _free_place(place, _label_size(text), taken)
        taken = np.concatenate((taken, label[None]))
        low, high = np.rint(label).astype(int)
        cv2.rectangle(picture, low.tolist(), (high - 1).tolist(), _LABEL, -1)
        write_text(picture, text, (int(low[0]) + 4, int(high[1]) - 5), LEGEND)


def _label_size(text: str) -> NDArray[np.int64]:
    return np.array((measure_text(text, LEGEND) + 8, LEGEND + 6))


def _free_place(place: NDArray[np.float64], size: NDArray[np.int64], taken: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns the (2, 2) lower and upper corner of a label near a place: the nearest that covers no other."""
    for step in _AROUND:
        label = place + size * step + np.stack((-size / 2, size / 2))
        if not ((label[0] < taken[:, 1]) & (label[1] > taken[:, 0])).all(axis=1).any():
            return label
    return place + np.stack((-size / 2, size / 2))


def _shortened(name: str) -> str:
    return name if len(name) <= _LONGEST_NAME else name[: _LONGEST_NAME - 3] + "..."
