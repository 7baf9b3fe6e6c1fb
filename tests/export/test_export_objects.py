"""Objects as JSON, as glTF that trimesh loads, and as boxes in COCO's layout."""

import json

import numpy as np
import pytest
from labeled_rooms import labeled_room

from freeocc3d.core.errors import ConfigError, ExportError
from freeocc3d.core.transforms import invert, transform
from freeocc3d.export import export_map
from freeocc3d.export.export_frames import to_frame
from freeocc3d.query.scan_map import Map

trimesh = pytest.importorskip("trimesh")


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Map:
    return labeled_room(tmp_path_factory)


def test_json_gives_centroids_in_the_frame_and_boxes_to_the_map(room: Map, tmp_path) -> None:
    export_map(room, "objects", tmp_path / "o.json", {"frame": "start"})
    document = json.loads((tmp_path / "o.json").read_text(encoding="utf-8"))
    T = to_frame(room, "start")
    np.testing.assert_allclose(document["T_frame_map"], T)
    for told, found in zip(document["objects"], room.objects(), strict=True):
        np.testing.assert_allclose(told["centroid"], transform(T, found.centroid), atol=1e-4)
        np.testing.assert_allclose(told["oriented_box"]["T_map_box"], found.box.T_map_box, atol=1e-6)
    with pytest.raises(ConfigError, match=r"end the name in \.json"):
        export_map(room, "objects", tmp_path / "o.glb", {"layout": "coco"})
    with pytest.raises(ConfigError, match=r"\.json or \.glb"):
        export_map(room, "objects", tmp_path / "o.txt")


@pytest.mark.parametrize("frame", ["gravity", "start"])
def test_each_object_is_a_node_with_its_name_place_and_surface(room: Map, tmp_path, frame: str) -> None:
    export_map(room, "objects", tmp_path / "o.glb", {"frame": frame})
    scene = trimesh.load(tmp_path / "o.glb")
    T = to_frame(room, frame)
    objects = room.objects()
    assert len(scene.geometry) == len(objects)
    for number, thing in enumerate(objects, start=1):
        T_world_node, geometry = scene.graph[f"{thing.name} {number}"]
        mesh = scene.geometry[geometry]
        np.testing.assert_allclose(np.ptp(mesh.vertices, axis=0), thing.box.extent, atol=1e-5)
        x, y, z = transform(T, thing.box.T_map_box[:3, 3])
        np.testing.assert_allclose(transform(T_world_node, np.zeros(3)), (x, z, -y), atol=1e-5)
        merged = trimesh.Trimesh(mesh.vertices, mesh.faces, process=True)
        merged.merge_vertices(merge_tex=True, merge_norm=True)
        assert merged.volume == pytest.approx(thing.volume_m3, rel=1e-3)  # positive: faces look outwards


def test_coco_boxes_project_onto_what_the_keyframes_show(room: Map, tmp_path) -> None:
    export_map(room, "objects", tmp_path / "o.json", {"layout": "coco"})
    document = json.loads((tmp_path / "o.json").read_text(encoding="utf-8"))
    images = {image["id"]: image for image in document["images"]}
    names = {category["id"]: category["name"] for category in document["categories"]}
    objects = room.objects()
    assert all((room.path / image["file_path"]).is_file() for image in images.values())
    assert len({told["id"] for told in document["annotations"]}) == len(document["annotations"]) > len(objects) / 2
    for told in document["annotations"]:
        thing, image = objects[told["object"] - 1], images[told["image_id"]]
        assert names[told["category_id"]] == told["category_name"] == thing.name
        corners = np.array(told["bbox3D_cam"])
        R, (width, height, length) = np.array(told["R_cam"]), told["dimensions"]
        assert np.linalg.det(R) == pytest.approx(1, abs=1e-4)
        edges = corners[[1, 3, 4]] - corners[0]
        np.testing.assert_allclose(edges, R.T * np.array((length, height, width))[:, None], atol=2e-4)
        T = np.array(image["T_map_cam"])
        np.testing.assert_allclose(transform(T, corners.mean(axis=0)), thing.box.T_map_box[:3, 3], atol=1e-3)
        assert (T[:3, :3] @ R)[2, 1] == pytest.approx(-1, abs=1e-4)  # the object's y points down
        inside = transform(invert(thing.box.T_map_box), transform(T, corners))
        np.testing.assert_allclose(np.abs(inside), np.tile(thing.box.extent / 2, (8, 1)), atol=1e-3)
        x, y, w, h = told["bbox"]
        assert told["bbox2D_tight"] == [x, y, x + w, y + h]
        if not told["behind_camera"]:
            pixels = corners @ np.array(image["K"]).T
            pixels = pixels[:, :2] / pixels[:, 2:]
            low, high = np.array(told["bbox2D_proj"]).reshape(2, 2)
            np.testing.assert_allclose((low, high), (pixels.min(axis=0), pixels.max(axis=0)), atol=0.3)
            assert (low <= (x + 2, y + 2)).all()
            assert (high >= (x + w - 2, y + h - 2)).all()
            assert 0 <= told["truncation"] <= 1


def test_a_map_without_objects_is_not_exported(room: Map, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(room, "objects", list)
    with pytest.raises(ExportError, match="No objects"):
        export_map(room, "objects", tmp_path / "o.json")
    assert list(tmp_path.iterdir()) == []
