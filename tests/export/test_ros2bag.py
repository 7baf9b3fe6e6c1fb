"""Bags of maps, read by rosbags, and by the package mcap with the decoder of Foxglove's mcap-ros2-support."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import yaml
from exported_maps import CAMERA_TO_UP, Z_UP, map_of, map_server, of_several_sizes, room
from scenes import occupancy_of

from freeocc3d.core.errors import ExportError
from freeocc3d.core.transforms import quats_to_rotations
from freeocc3d.core.types import OCCUPIED
from freeocc3d.export import export_map
from freeocc3d.export.export_frames import place_voxels
from freeocc3d.export.ros_messages import OCTOMAP, load_types

TOPICS = {"/map", "/occupied_voxels", "/octomap_binary", "/camera_path", "/map_info", "/tf_static"}


def map_with_times(occupancy: Any, T_gravity_map: Any = Z_UP) -> SimpleNamespace:
    scan_map = map_of(occupancy, T_gravity_map)
    scan_map.trajectory.timestamps = np.array((0.0, 12.5))
    return scan_map


def read_with_rosbags(path: Path) -> dict[str, Any]:
    from rosbags.highlevel import AnyReader

    with AnyReader([path]) as reader:
        return {at.topic: reader.deserialize(data, at.msgtype) for at, _, data in reader.messages()}


def read_with_mcap(path: Path) -> dict[str, Any]:
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        return {channel.topic: message for _, channel, _, message in reader.iter_decoded_messages()}


def points_of(cloud: Any) -> dict[str, Any]:
    """Columns of a PointCloud2, as its fields describe them."""
    types = {7: "<f4", 4: "<u2"}
    table = np.dtype(
        {
            "names": [field.name for field in cloud.fields],
            "formats": [types[field.datatype] for field in cloud.fields],
            "offsets": [field.offset for field in cloud.fields],
            "itemsize": cloud.point_step,
        }
    )
    points = np.frombuffer(bytes(cloud.data), table)
    assert len(points) == cloud.width * cloud.height
    assert cloud.row_step == len(bytes(cloud.data))
    return {name: points[name] for name in table.names or ()}


@pytest.fixture(params=["folder", "file"])
def messages(request: pytest.FixtureRequest, tmp_path: Path) -> dict[str, Any]:
    """The messages of the room, read by both packages."""
    name = "room" if request.param == "folder" else "room.mcap"
    export_map(map_with_times(room()[0]), "ros2bag", tmp_path / name, {"max_height": 1.7})
    if request.param == "folder":
        assert sorted(file.name for file in (tmp_path / name).iterdir()) == ["metadata.yaml", "room.mcap"]
        return read_with_rosbags(tmp_path / name)
    assert [file.name for file in tmp_path.iterdir()] == ["room.mcap"]
    return read_with_mcap(tmp_path / name)


def test_all_topics_are_there(messages: dict[str, Any]) -> None:
    assert set(messages) == TOPICS
    assert messages["/map"].header.frame_id == messages["/occupied_voxels"].header.frame_id == "map"


def test_the_grid_is_that_of_map_server(messages: dict[str, Any], tmp_path: Path) -> None:
    export_map(map_of(room()[0], Z_UP), "nav2", tmp_path / "plan.yaml", {"max_height": 1.7})
    data, resolution, origin = map_server(tmp_path / "plan.yaml")
    grid = messages["/map"]
    assert set(np.unique(data)) == {-1, 0, 100}
    np.testing.assert_array_equal(np.array(grid.data).reshape(grid.info.height, grid.info.width), data)
    assert grid.info.resolution == pytest.approx(resolution)
    np.testing.assert_allclose((grid.info.origin.position.x, grid.info.origin.position.y), origin, atol=1e-6)


def test_the_cloud_holds_the_occupied_voxels(messages: dict[str, Any]) -> None:
    scan_map = map_of(room()[0], Z_UP)
    there = place_voxels(scan_map, "gravity")
    occupancy, points = there.occupancy, points_of(messages["/occupied_voxels"])
    centers = occupancy.centers(occupancy.occupied_voxels())
    np.testing.assert_allclose(np.column_stack([points[name] for name in "xyz"]), centers, atol=1e-6)
    colors = points["rgb"].view(np.uint32)
    np.testing.assert_array_equal(np.column_stack([colors >> shift & 255 for shift in (16, 8, 0)]), occupancy.colors)
    np.testing.assert_array_equal(points["label"], scan_map.labels()[there.rows])
    np.testing.assert_array_equal(points["probability"], occupancy.probability[occupancy.state == OCCUPIED])
    np.testing.assert_allclose(points["size"], 0.1, rtol=1e-6)


def test_the_octree_is_that_of_the_bt_file(messages: dict[str, Any], tmp_path: Path) -> None:
    export_map(map_of(room()[0], Z_UP), "octomap", tmp_path / "room.bt")
    tree = messages["/octomap_binary"]
    assert tree.header.frame_id == "octree"
    assert (tree.binary, tree.id, tree.resolution) == (True, "OcTree", pytest.approx(0.1))
    assert np.array(tree.data, np.int8).tobytes() == (tmp_path / "room.bt").read_bytes().split(b"data\n", 1)[1]


def test_the_words_and_the_frame_are_told(messages: dict[str, Any]) -> None:
    told = json.loads(messages["/map_info"].data)
    assert told["classes"] == ["", "cup", "table"]
    assert (told["frame"], told["metric"]) == ("gravity", True)


def test_frames_and_the_camera_path(tmp_path: Path) -> None:
    occupancy = occupancy_of([(1, 14, 20), (1, 14, 21)], free=[(0, 14, 20)])
    export_map(
        map_with_times(occupancy, CAMERA_TO_UP), "ros2bag", tmp_path / "bag", {"max_height": 100, "min_height": -100}
    )
    messages = read_with_rosbags(tmp_path / "bag")
    stamped, octree = messages["/tf_static"].transforms
    assert (stamped.header.frame_id, stamped.child_frame_id) == ("map", "scan")
    assert (octree.header.frame_id, octree.child_frame_id) == ("map", "octree")
    np.testing.assert_allclose(matrix(octree.transform.rotation, octree.transform.translation), np.eye(4), atol=1e-9)
    np.testing.assert_allclose(
        matrix(stamped.transform.rotation, stamped.transform.translation), CAMERA_TO_UP, atol=1e-9
    )
    (camera,) = messages["/camera_path"].poses
    assert camera.header.stamp.sec + camera.header.stamp.nanosec * 1e-9 == 12.5
    np.testing.assert_allclose(matrix(camera.pose.orientation, camera.pose.position), CAMERA_TO_UP, atol=1e-9)


def matrix(q: Any, at: Any) -> np.ndarray[Any, Any]:
    T = np.eye(4)
    T[:3, :3] = quats_to_rotations(np.array((q.w, q.x, q.y, q.z)))
    T[:3, 3] = at.x, at.y, at.z
    return T


def test_topics_are_latched_in_a_form_that_humble_reads(tmp_path: Path) -> None:
    export_map(map_with_times(room()[0]), "ros2bag", tmp_path / "bag", {"max_height": 1.7})
    told = yaml.safe_load((tmp_path / "bag" / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    assert told["storage_identifier"] == "mcap"
    assert told["relative_file_paths"] == ["bag.mcap"]
    for topic in told["topics_with_message_count"]:
        (profile,) = yaml.safe_load(topic["topic_metadata"]["offered_qos_profiles"])
        assert (profile["durability"], profile["reliability"], profile["depth"]) == (1, 1, 1)


def test_the_same_map_gives_the_same_bytes(tmp_path: Path) -> None:
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        export_map(map_with_times(room()[0]), "ros2bag", tmp_path / name / "room.mcap", {"max_height": 1.7})
    assert (tmp_path / "a" / "room.mcap").read_bytes() == (tmp_path / "b" / "room.mcap").read_bytes()


def test_parts_and_refusals(tmp_path: Path) -> None:
    scan_map = map_with_times(of_several_sizes())
    heights = {"min_height": -10, "max_height": 10}
    export_map(scan_map, "ros2bag", tmp_path / "a", {**heights, "octomap": False})
    assert "/octomap_binary" not in read_with_rosbags(tmp_path / "a")
    with pytest.raises(ExportError, match="exists"):
        export_map(scan_map, "ros2bag", tmp_path / "a", heights)
    with pytest.raises(ExportError, match="Nothing is known between the heights"):
        export_map(scan_map, "ros2bag", tmp_path / "b", {"min_height": 500, "max_height": 600})
    assert not (tmp_path / "b").exists()


def test_octomap_reads_the_message(tmp_path: Path) -> None:
    """The nodes behind a header of a .bt are what OctoMap's node reads from the message."""
    pyoctomap = pytest.importorskip("pyoctomap")
    export_map(map_with_times(room()[0]), "ros2bag", tmp_path / "bag", {"max_height": 1.7})
    message = read_with_rosbags(tmp_path / "bag")["/octomap_binary"]
    nodes = bytes(message.data.tobytes())
    export_map(map_of(room()[0], Z_UP), "octomap", tmp_path / "room.bt")
    size = (tmp_path / "room.bt").read_bytes().split(b"size ")[1].split(b"\n")[0].decode()
    header = f"# Octomap OcTree binary file\nid {message.id}\nsize {size}\nres {message.resolution}\ndata\n"
    (tmp_path / "again.bt").write_bytes(header.encode() + nodes)
    tree = pyoctomap.OcTree(0.5)
    assert tree.readBinary(str(tmp_path / "again.bt"))
    occupancy = place_voxels(map_of(room()[0], Z_UP), "gravity", origin=(0, 0, 0)).occupancy
    for center in occupancy.centers(occupancy.occupied_voxels()):
        assert tree.isNodeOccupied(tree.search(center))


def test_the_definition_of_octomap_is_that_of_its_package() -> None:
    """ROS 1 names a definition by a hash of its fields; nodes of octomap_msgs refuse another one."""
    from rosbags.typesys import Stores, get_typestore

    types = get_typestore(Stores.ROS1_NOETIC)
    types.register({OCTOMAP: load_types().fielddefs[OCTOMAP]})
    assert types.generate_msgdef(OCTOMAP, ros_version=1)[1] == "9a45536b45c5e409cd49f04bb2d9999f"
