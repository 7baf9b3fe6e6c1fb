"""The objects that a map keeps: what is written reads back, and what no map has is told before it is used."""

from __future__ import annotations

import tracemalloc
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from manifests import tiny_manifest
from msgspec import structs

from freeocc3d.core.errors import MapError
from freeocc3d.storage.manifest import Manifest, VoxelCounts
from freeocc3d.storage.objects_file import ObjectArrays, read_objects, write_objects

OBJECTS = ObjectArrays(
    instance=np.array([1, -1, 0, 1], np.int32),
    feature=np.eye(2, 3, dtype=np.float32),
    confidence=np.array([0.9, 0.2]),
    extent=np.ones((2, 3)),
    yaw=np.array([0.0, 1.0]),
    T_map_box=np.stack((np.eye(4), np.eye(4))),
    volume_m3=np.array([0.1, 0.2]),
    centroid=np.zeros((2, 3)),
    names=np.frombuffer("cup\nTür\n".encode(), np.uint8),
    name=np.array([1, 0], np.int32),
    name_object=np.array([0, 0], np.int32),
    probability=np.array([0.7, 0.3]),
    view_object=np.array([1], np.int32),
    frame=np.array([2], np.int32),
    box=np.array([[0, 0, 3, 4]], np.int32),
    visible=np.array([0.5]),
)


def manifest(objects: int = 2) -> Manifest:
    made = tiny_manifest(objects=objects)
    counts = structs.replace(made.counts, voxels=VoxelCounts(occupied=4, free=2))
    return structs.replace(made, counts=counts, encoder=structs.replace(made.encoder, dimension=3))


def arrays(objects: ObjectArrays = OBJECTS) -> dict[str, Any]:
    return {field.name: getattr(objects, field.name) for field in fields(objects)}


def test_what_is_written_is_read(tmp_path: Path) -> None:
    write_objects(tmp_path / "objects.npz", OBJECTS)
    found = read_objects(tmp_path / "objects.npz", manifest())
    assert found.list_names() == ["cup", "Tür"]
    assert len(found) == 2
    for name, values in arrays(found).items():
        np.testing.assert_array_equal(values, getattr(OBJECTS, name))


def changed(name: str, value: Any, at: Any = (0,)) -> dict[str, Any]:
    values = getattr(OBJECTS, name).copy()
    values[at] = value
    return {name: values}


DAMAGED: dict[str, dict[str, Any]] = {
    "an object without voxels": changed("instance", 1, 2),
    "a third object": changed("instance", 2, 1),
    "an object before the first": changed("instance", -2, 1),
    "a voxel less": {"instance": OBJECTS.instance[:-1]},
    "wide rows": {"instance": OBJECTS.instance.astype(np.int64)},
    "wide features": {"feature": OBJECTS.feature.astype(np.float64)},
    "features of another encoder": {"feature": OBJECTS.feature[:, :2]},
    "a long feature": changed("feature", 1.1),
    "a feature that is no number": changed("feature", np.nan),
    "a confidence above 1": changed("confidence", 1.1),
    "a flat box": changed("extent", 0.0),
    "an infinite box": changed("extent", np.inf),
    "no volume": changed("volume_m3", -1.0),
    "a turn of many rounds": changed("yaw", 40.0),
    "a far place": changed("centroid", 1e12),
    "a box that is not rigid": changed("T_map_box", 2.0, (0, 0, 0)),
    "bytes that are no text": changed("names", 255),
    "a long name": {"names": np.full(300, 10 + 87, np.uint8).tolist() + [10]},
    "a name that is not there": changed("name", 2),
    "a name of nobody": changed("name_object", 2),
    "a name less": {"name_object": OBJECTS.name_object[:1]},
    "a probability that is no number": changed("probability", np.nan),
    "a view of nobody": changed("view_object", -1),
    "a frame that is no keyframe": changed("frame", 1),
    "a view less": {"visible": OBJECTS.visible[:0]},
    "a box from right to left": changed("box", 5, (0, 0)),
    "a box outside of all images": changed("box", 1 << 20, (0, 2)),
    "more than everything visible": changed("visible", 1.5),
    "texts": {"name": np.array(["cup", "door"])},
    "records": {"box": OBJECTS.box.view([("x", np.int32)])},
}


@pytest.mark.parametrize("kind", DAMAGED)
def test_objects_that_no_map_has_are_told(tmp_path: Path, kind: str) -> None:
    change = {
        name: np.array(value, np.uint8) if isinstance(value, list) else value for name, value in DAMAGED[kind].items()
    }
    np.savez(tmp_path / "objects.npz", **(arrays() | change))
    with pytest.raises(MapError, match=r"objects\.npz is damaged: .*\.$"):
        read_objects(tmp_path / "objects.npz", manifest())


@pytest.mark.parametrize("count", [1, 3, 4, 5, 1 << 50])
def test_another_number_of_objects_than_the_manifest_states_is_told(tmp_path: Path, count: int) -> None:
    write_objects(tmp_path / "objects.npz", OBJECTS)
    with pytest.raises(MapError, match=r"objects\.npz is damaged"):
        read_objects(tmp_path / "objects.npz", manifest(count))


@pytest.mark.parametrize("name", ["names", "name", "box"])
def test_an_array_that_is_larger_than_objects_need_is_not_unpacked(tmp_path: Path, name: str) -> None:
    before = getattr(OBJECTS, name)
    huge = np.zeros((50_000_000, *before.shape[1:]), before.dtype)
    np.savez_compressed(tmp_path / "objects.npz", **(arrays() | {name: huge}))
    del huge
    tracemalloc.start()
    try:
        with pytest.raises(MapError, match="more than is possible here"):
            read_objects(tmp_path / "objects.npz", manifest())
        assert tracemalloc.get_traced_memory()[1] < 5 << 20
    finally:
        tracemalloc.stop()


def test_a_map_may_keep_that_it_has_no_objects(tmp_path: Path) -> None:
    empty = replace(OBJECTS, **{name: values[:0] for name, values in arrays().items() if name != "instance"})
    write_objects(tmp_path / "objects.npz", replace(empty, instance=np.full(4, -1, np.int32)))
    assert len(read_objects(tmp_path / "objects.npz", manifest(0))) == 0
