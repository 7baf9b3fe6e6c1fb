"""ROS 2: a bag (MCAP) for RViz, Foxglove and nodes: grid, cloud, octree, transforms, camera path, class names.

    /map               nav_msgs/OccupancyGrid: obstacles between two heights, 0 free, 100 occupied, -1 unknown
    /occupied_voxels   sensor_msgs/PointCloud2: x, y, z, rgb, probability, label, size
    /octomap_binary    octomap_msgs/Octomap: free and occupied space
    /camera_path       nav_msgs/Path: x right, y down, z forward
    /map_info          std_msgs/String: JSON with the class names by label, the frame and the unit
    /tf_static         map -> scan, the map's own frame; map -> octree, which is at most half a voxel away

All topics are latched (transient local). A name that ends in .mcap gives one file, for Foxglove; any other a folder of
rosbag2, which `ros2 bag play` plays and Foxglove opens too. Source: rosbag2's metadata, mcap.dev/spec.
"""

from __future__ import annotations

import json
import tempfile
from pathlib import Path
from typing import Any

from ..core.errors import ExportError
from ..core.transforms import invert
from ..query.scan_map import Map
from .export_frames import VoxelOptions
from .nav2 import PlanOptions, make_plan
from .octomap import encode_binary, make_tree
from .ros_messages import load_types, make_cloud, make_grid, make_octomap, make_path, make_text, make_transforms

REQUIRES: tuple[str, ...] = ("rosbags",)

ENDINGS = (".mcap", "")

SCAN_FRAME = "scan"
"""Name of the map's own frame."""
OCTREE_FRAME = "octree"
"""Name of the octree's frame. Its nodes lie at multiples of the voxel, those of a map with the floor inside a layer do
not."""

_TIME_NS = 10**9  # of all messages: a bag's players take 0 for a mistake


class Options(PlanOptions, frozen=True):
    """The frame, the box, and the heights of the grid."""

    octomap: bool = True
    """Write the octree too."""


def write(scan_map: Map, path: Path, options: Options) -> None:
    """Writes the bag. Raises ExportError if nothing is known between the heights, or for what an octree cannot hold."""
    plan = make_plan(scan_map, options)
    there = plan.there
    names = ["", *scan_map.vocabulary]
    messages = {
        "/map": make_grid(plan.cells, plan.grid, plan.floor_z),
        "/occupied_voxels": make_cloud(there.occupancy, scan_map.labels()[there.rows]),
        "/map_info": make_text(json.dumps({"classes": names, **there.described()})),
    }
    frames = {SCAN_FRAME: there.T_frame_map}
    if options.octomap:
        placed, tree = make_tree(scan_map, VoxelOptions(frame=options.frame, box=options.box))
        frames[OCTREE_FRAME] = there.T_frame_map @ invert(placed.T_frame_map)
        messages["/octomap_binary"] = make_octomap(encode_binary(tree), placed.occupancy.finest, OCTREE_FRAME)
    messages["/tf_static"] = make_transforms(frames)
    posed = scan_map.trajectory.has_pose
    if posed.any():
        T_frame_cam = there.T_frame_map @ scan_map.trajectory.T_world_cam[posed]
        messages["/camera_path"] = make_path(T_frame_cam, scan_map.trajectory.timestamps[posed])
    if path.suffix == ".mcap":
        with tempfile.TemporaryDirectory(dir=path.parent) as folder:
            bag = Path(folder) / path.stem
            _write_bag(bag, messages)
            (bag / f"{bag.name}.mcap").rename(path)
    else:
        _write_bag(path, messages)


def _write_bag(path: Path, messages: dict[str, Any]) -> None:
    """Writes a folder of rosbag2 with metadata.yaml and NAME.mcap."""
    from rosbags.rosbag2 import StoragePlugin, Writer, WriterError

    types = load_types()
    try:
        with Writer(path, version=8, storage_plugin=StoragePlugin.MCAP) as bag:
            for topic, message in messages.items():
                kind = message.__msgtype__
                connection = bag.add_connection(topic, kind, typestore=types, offered_qos_profiles=[_latched()])
                bag.write(connection, _TIME_NS, types.serialize_cdr(message, kind))
    except WriterError as error:
        raise ExportError(f"Cannot write {path}: {error}") from error


def _latched() -> Any:
    """The quality of service of topics whose last message new subscribers get."""
    from rosbags import interfaces as of

    unset = of.QosTime(0, 0)
    return of.Qos(
        of.QosHistory.KEEP_LAST, 1, of.QosReliability.RELIABLE, of.QosDurability.TRANSIENT_LOCAL, unset, unset,
        of.QosLiveliness.AUTOMATIC, unset, False,
    )  # fmt: skip
