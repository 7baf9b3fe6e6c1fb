"""Objects as the arrays that a map keeps, so that who asks it does not have to find them again."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ...core.errors import ModelError
from ...language.encoders.base import Encoder
from ...language.encoders.color import ColorWords
from ...storage.objects_file import LONGEST_NAME, ObjectArrays
from ...storage.saved_map import SavedMap
from ..best_views import RegionView
from ..oriented_boxes import OrientedBox
from .object import Object


def find_kept_objects(folder: Path, encoder: Encoder | None = None) -> ObjectArrays | None:
    """Returns the objects that the map in a folder is to keep; None for a map that knows only colors, or whose text
    network is not installed. encoder: the map's, if it is loaded. Raises MapError for a damaged map."""
    from .finding import find_objects

    scan_map = SavedMap.open(folder)
    if isinstance(scan_map.text_encoder, ColorWords):
        return None
    if encoder is not None:
        scan_map.encoder = encoder
    with contextlib.suppress(ModelError):
        return pack_objects(find_objects(scan_map), len(scan_map.occupancy.colors), scan_map.manifest.encoder.dimension)
    return None


def pack_objects(objects: Sequence[Object], voxels: int, dimension: int) -> ObjectArrays:
    """Returns objects as arrays. voxels: number of occupied voxels.  dimension: of the map's features."""
    count = len(objects)
    instance = np.full(voxels, -1, np.int32)
    for number, thing in enumerate(objects):
        instance[thing.rows] = number
    named = [(number, _line(name), share) for number, thing in enumerate(objects) for name, share in thing.names]
    names = sorted({name for _, name, _ in named})
    line = {name: row for row, name in enumerate(names)}
    seen = [(number, view) for number, thing in enumerate(objects) for view in thing.keyframes]
    return ObjectArrays(
        instance=instance,
        feature=np.array([thing.feature for thing in objects], np.float32).reshape(count, dimension),
        confidence=np.array([thing.confidence for thing in objects], np.float64),
        extent=np.array([thing.box.extent for thing in objects], np.float64).reshape(count, 3),
        yaw=np.array([thing.box.yaw for thing in objects], np.float64),
        T_map_box=np.array([thing.box.T_map_box for thing in objects], np.float64).reshape(count, 4, 4),
        volume_m3=np.array([thing.volume_m3 for thing in objects], np.float64),
        centroid=np.array([thing.centroid for thing in objects], np.float64).reshape(count, 3),
        names=np.frombuffer("".join(f"{name}\n" for name in names).encode(), np.uint8),
        name=np.array([line[name] for _, name, _ in named], np.int32),
        name_object=np.array([number for number, _, _ in named], np.int32),
        probability=np.array([share for _, _, share in named], np.float64),
        view_object=np.array([number for number, _ in seen], np.int32),
        frame=np.array([view.frame for _, view in seen], np.int32),
        box=np.array([view.box for _, view in seen], np.int32).reshape(-1, 4),
        visible=np.array([view.visible for _, view in seen], np.float64),
    )


def unpack_objects(arrays: ObjectArrays) -> list[Object]:
    """Returns the objects of ``pack_objects``."""
    order = np.argsort(arrays.instance, kind="stable")
    ends = np.searchsorted(arrays.instance[order], np.arange(len(arrays) + 1))
    words = arrays.list_names()
    names: list[list[tuple[str, float]]] = [[] for _ in range(len(arrays))]
    told = (values.tolist() for values in (arrays.name_object, arrays.name, arrays.probability))
    for number, line, share in zip(*told, strict=True):
        names[number].append((words[line], share))
    views: list[list[RegionView]] = [[] for _ in range(len(arrays))]
    seen = (values.tolist() for values in (arrays.view_object, arrays.frame, arrays.box, arrays.visible))
    for number, frame, (x0, y0, x1, y1), visible in zip(*seen, strict=True):
        views[number].append(RegionView(frame, (x0, y0, x1, y1), visible))
    return [
        Object(
            rows=order[ends[k] : ends[k + 1]],
            feature=arrays.feature[k],
            names=tuple(names[k]),
            box=OrientedBox(arrays.extent[k], float(arrays.yaw[k]), arrays.T_map_box[k]),
            volume_m3=float(arrays.volume_m3[k]),
            centroid=arrays.centroid[k],
            keyframes=tuple(views[k]),
            confidence=float(arrays.confidence[k]),
        )
        for k in range(len(arrays))
    ]


def _line(name: str) -> str:
    return name.replace("\n", " ")[:LONGEST_NAME]
