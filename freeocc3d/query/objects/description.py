"""Objects as plain values, for documents that others read."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.transforms import transform
from .object import Object
from .relations import Relation


def describe_objects(
    objects: Sequence[Object], relations: Sequence[Sequence[Relation]], T_frame_map: NDArray[np.float64] | None = None
) -> list[dict[str, Any]]:
    """Returns one record for each object, numbered from 1 in the order that is given; see the reference of
    ``objects --json``. T_frame_map: (4, 4), to the frame of the centroids; by default the map's."""
    T = np.eye(4) if T_frame_map is None else T_frame_map
    return [
        {
            "number": number,
            "name": thing.name,
            "names": [{"name": name, "probability": round(share, 4)} for name, share in thing.names],
            "confidence": round(thing.confidence, 4),
            "centroid": transform(T, thing.centroid).round(4).tolist(),
            "oriented_box": {
                "extent": thing.box.extent.round(4).tolist(),
                "yaw": round(thing.box.yaw, 6),
                "T_map_box": thing.box.T_map_box.round(6).tolist(),
            },
            "volume_m3": round(thing.volume_m3, 6),
            "voxels": len(thing.rows),
            "keyframes": [
                {"frame": view.frame, "box": list(view.box), "visible": round(view.visible, 4)}
                for view in thing.keyframes
            ],
            "relations": [
                {
                    "kind": relation.kind,
                    "other": None if relation.other is None else relation.other + 1,
                    "gap_m": round(relation.gap_m, 4),
                }
                for relation in own
            ],
        }
        for number, (thing, own) in enumerate(zip(objects, relations, strict=True), start=1)
    ]


def tell_relations(objects: Sequence[Object], relations: Sequence[Relation], most_near: int = 2) -> list[str]:
    """Returns relations of one object in words, such as "on dining table 4". most_near: of things next to it, nearest
    first."""
    told, near = [], 0
    for relation in relations:
        near += relation.kind == "next to"
        if near <= most_near or relation.kind != "next to":
            other = "a wall" if relation.other is None else f"{objects[relation.other].name} {relation.other + 1}"
            told.append(f"{relation.kind} {other}")
    return told
