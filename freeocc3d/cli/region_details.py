"""What ``query --json`` says of a region beyond what the query found: its box, keyframes, and where to see it from."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

from ..query.oriented_boxes import oriented_boxes
from ..query.regions import Region
from ..query.word_query import QueryResult
from ..storage.store import Map

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from ..query.best_views import View


def details(scan_map: Map, results: Sequence[QueryResult], views: bool = False) -> Callable[[Region], dict[str, Any]]:
    """What gives further keys of a region, for ``query.to_json``.

    oriented_box: extent (metres along its own axes), yaw (radians, gravity frame), T_map_box (4 x 4).
    views: also keyframes, the frame, pixel box x0 y0 x1 y1 and visible share of those that show it best, and stand,
    the nearest place x y z on the floor where a robot could stand and see it, null where there is none, or
    where lengths are not metres.
    """
    regions = [region for result in results for region in result.regions]
    number = {id(region): n for n, region in enumerate(regions)}
    boxes = oriented_boxes(scan_map.occupancy, regions, scan_map.T_gravity_map) if regions else []
    seen: list[list[View]] = []
    stands: list[NDArray[np.float64] | None] = []
    if views and regions:
        from ..query.best_views import best_views

        seen = best_views(scan_map.occupancy, scan_map.trajectory, scan_map.keyframes, regions)
        stands = scan_map.standing_places(regions)

    def more(region: Region) -> dict[str, Any]:
        box = boxes[number[id(region)]]
        said: dict[str, Any] = {
            "oriented_box": {
                "extent": box.extent.round(4).tolist(),
                "yaw": round(box.yaw, 6),
                "T_map_box": box.T_map_box.round(6).tolist(),
            }
        }
        if views:
            said["keyframes"] = [
                {"frame": view.frame, "box": list(view.box), "visible": round(view.visible, 4)}
                for view in seen[number[id(region)]]
            ]
            place = stands[number[id(region)]]
            said["stand"] = None if place is None else place.round(4).tolist()
        return said

    return more
