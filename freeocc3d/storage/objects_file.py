"""The objects of a map in objects.npz, as arrays. What an object is, the room ``query`` says."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.arrays import Shape, read_arrays, write_arrays
from ..core.errors import MapError
from ..core.transforms import is_rigid
from .manifest import Manifest

LONGEST_NAME = 200
_LEAST_BYTES, _OBJECT_BYTES, _MOST_BYTES = 1 << 16, 1 << 14, 1 << 30
_WIDEST_IMAGE, _FARTHEST = 1 << 16, 1e9
_UNIT = 1e-3  # features of half precision are so near to unit length


@dataclass(frozen=True)
class ObjectArrays:
    """N objects, best described first, in a map of V occupied voxels and features of D dimensions.

    instance: (V,) int32 object of each occupied voxel, -1 for none.  feature: (N, D) float32.  confidence: (N,).
    extent: (N, 3) meters, yaw: (N,) radians, T_map_box: (N, 4, 4), of the oriented boxes.  volume_m3: (N,).  centroid:
    (N, 3) map frame, meters.
    names: (bytes,) uint8, all different names in UTF-8, each with a line end.  name: (M,) int32 line of a name,
    name_object: (M,) int32 whose it is, most probable first.  probability: (M,) of the names.
    view_object: (W,) int32 object that a view shows, best view first.  frame: (W,) int32 frame of the capture.  box:
    (W, 4) int32 pixels x0, y0, x1, y1.  visible: (W,) share of the object.
    """

    instance: NDArray[np.int32]
    feature: NDArray[np.float32]
    confidence: NDArray[np.float64]
    extent: NDArray[np.float64]
    yaw: NDArray[np.float64]
    T_map_box: NDArray[np.float64]
    volume_m3: NDArray[np.float64]
    centroid: NDArray[np.float64]
    names: NDArray[np.uint8]
    name: NDArray[np.int32]
    name_object: NDArray[np.int32]
    probability: NDArray[np.float64]
    view_object: NDArray[np.int32]
    frame: NDArray[np.int32]
    box: NDArray[np.int32]
    visible: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.feature)

    def list_names(self) -> list[str]:
        """The different names. Raises ValueError for bytes that are no text."""
        return self.names.tobytes().decode().split("\n")[:-1]


def write_objects(path: Path, objects: ObjectArrays) -> None:
    """Write objects.npz. Raises OSError."""
    write_arrays(path, {field.name: getattr(objects, field.name) for field in fields(objects)}, compressed=True)


def read_objects(path: Path, manifest: Manifest) -> ObjectArrays:
    """Read objects.npz. Raises MapError."""
    voxels, count, dimension = manifest.counts.voxels.occupied, manifest.objects or 0, manifest.encoder.dimension
    if count > voxels:
        raise MapError(f"{path} is damaged: it cannot hold more objects than there are occupied voxels.")
    most = min(_LEAST_BYTES + 4 * voxels + (4 * dimension + _OBJECT_BYTES) * count, _MOST_BYTES)
    objects = ObjectArrays(**read_arrays(path, _expected(voxels, count, dimension), most_bytes=most))
    if problem := _problem(objects, manifest):
        raise MapError(f"{path} is damaged: {problem}.")
    return objects


def _expected(voxels: int, count: int, dimension: int) -> dict[str, tuple[str, Shape]]:
    """Kind and shape of each array."""
    return {
        "instance": ("i", (voxels,)), "feature": ("f", (count, dimension)), "confidence": ("f", (count,)),
        "extent": ("f", (count, 3)), "yaw": ("f", (count,)), "T_map_box": ("f", (count, 4, 4)),
        "volume_m3": ("f", (count,)), "centroid": ("f", (count, 3)),
        "names": ("u", (None,)), "name": ("i", (None,)), "name_object": ("i", (None,)), "probability": ("f", (None,)),
        "view_object": ("i", (None,)), "frame": ("i", (None,)), "box": ("i", (None, 4)), "visible": ("f", (None,)),
    }  # fmt: skip


def _problem(objects: ObjectArrays, manifest: Manifest) -> str:
    """The problem of arrays whose kinds and shapes are right; empty if they have none."""
    kinds = {"instance": np.int32, "feature": np.float32, "names": np.uint8}
    if other := next((name for name, kind in kinds.items() if getattr(objects, name).dtype != kind), None):
        return f"its array '{other}' holds other numbers than maps have"
    held = np.unique(objects.instance)
    if not np.array_equal(held[held != -1], np.arange(len(objects))):
        return "its array 'instance' does not hold the voxels of its objects"
    lengths = {"name": len(objects.name), "view_object": len(objects.view_object)}
    of = {"name_object": "name", "probability": "name", "frame": "view_object", "box": "view_object",
          "visible": "view_object"}  # fmt: skip
    if other := next((name for name, one in of.items() if len(getattr(objects, name)) != lengths[one]), None):
        return f"its array '{other}' has another length than its array '{of[other]}'"
    return _problem_of_names(objects) or _problem_of_views(objects, manifest) or _problem_of_places(objects)


def _problem_of_names(objects: ObjectArrays) -> str:
    try:
        names = objects.list_names()
    except ValueError:
        return "its array 'names' holds bytes that are not text in UTF-8"
    if not all(len(name) <= LONGEST_NAME for name in names):
        return f"its array 'names' holds a name of more than {LONGEST_NAME} characters"
    if not (_number(objects.name, len(names)) and _number(objects.name_object, len(objects))):
        return "its arrays 'name' and 'name_object' hold names or objects that are not there"
    return "" if _within_one(objects.probability) else "its array 'probability' holds numbers outside 0 to 1"


def _problem_of_views(objects: ObjectArrays, manifest: Manifest) -> str:
    if not _number(objects.view_object, len(objects)) or not np.isin(objects.frame, manifest.keyframes).all():
        return "its arrays 'view_object' and 'frame' hold objects or keyframes that are not there"
    low, high = objects.box[:, :2], objects.box[:, 2:]
    if not ((low >= 0) & (low <= high) & (high < _WIDEST_IMAGE)).all():
        return "its array 'box' holds boxes that lie in no image"
    return "" if _within_one(objects.visible) else "its array 'visible' holds numbers outside 0 to 1"


def _problem_of_places(objects: ObjectArrays) -> str:
    if not _within_one(objects.confidence / (1 + _UNIT)):
        return "its array 'confidence' holds numbers outside 0 to 1"
    for name in ("extent", "volume_m3"):
        values: NDArray[Any] = getattr(objects, name)
        if not ((values > 0) & (values <= _FARTHEST**3)).all():
            return f"its array '{name}' holds numbers that are no sizes"
    if not (np.abs(objects.feature) <= 1 + _UNIT).all():
        return "its array 'feature' holds numbers outside -1 to 1"
    if not ((np.abs(objects.yaw) <= np.pi).all() and (np.abs(objects.centroid) <= _FARTHEST).all()):
        return "its arrays 'yaw' and 'centroid' hold numbers that are no places"
    sound = all(is_rigid(T) and np.abs(T).max() <= _FARTHEST for T in objects.T_map_box)
    return "" if sound else "its array 'T_map_box' holds a transform that is not rigid"


def _number(values: NDArray[np.integer], count: int) -> bool:
    """Whether all are from 0 to ``count - 1``."""
    return bool(((values >= 0) & (values < count)).all())


def _within_one(values: NDArray[np.floating]) -> bool:
    return bool(((values >= 0) & (values <= 1)).all())
