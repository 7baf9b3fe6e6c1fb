"""What ``query --json`` adds to a region: its oriented box, keyframes, and where to see it from."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..core.transforms import transform
from ..query.regions import Region
from ..query.scan_map import Map
from ..query.word_query import QueryResult

if TYPE_CHECKING:
    from ..query.best_views import RegionView
    from ..query.oriented_boxes import OrientedBox


def describe_regions(
    scan_map: Map, results: Sequence[QueryResult], views: bool, T_frame_map: NDArray[np.float64]
) -> Callable[[Region], dict[str, Any]]:
    """Returns a function that gives the further keys of a region, for ``answers_document``.

    oriented_box: extent (meters along its own axes), yaw (radians, gravity frame), T_map_box (4 x 4).
    views: also keyframes and stand. keyframes: frame, pixel box x0 y0 x1 y1 and visible share of the region in those
    that show it best. stand: the nearest place x y z on the floor where a robot could stand and see it, in the frame of
    (4, 4) ``T_frame_map``; null if there is none, or if lengths are not meters.
    """
    regions = [region for result in results for region in result.regions]
    if not regions:
        return lambda region: {}
    boxes = scan_map.boxes_of(regions)
    said: dict[int, dict[str, Any]] = {
        id(region): {"oriented_box": _box(box)} for region, box in zip(regions, boxes, strict=True)
    }
    if views:
        seen = scan_map.views_of_each(regions)
        for region, shown, place in zip(regions, seen, scan_map.stands_of(regions), strict=True):
            said[id(region)] |= {
                "keyframes": [_view(view) for view in shown],
                "stand": None if place is None else transform(T_frame_map, place).round(4).tolist(),
            }
    return lambda region: said[id(region)]


def _box(box: OrientedBox) -> dict[str, Any]:
    return {
        "extent": box.extent.round(4).tolist(),
        "yaw": round(box.yaw, 6),
        "T_map_box": box.T_map_box.round(6).tolist(),
    }


def _view(view: RegionView) -> dict[str, Any]:
    return {"frame": view.frame, "box": list(view.box), "visible": round(view.visible, 4)}
