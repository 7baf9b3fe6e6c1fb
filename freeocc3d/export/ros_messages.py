"""Messages of ROS 2 for a map: OccupancyGrid, PointCloud2, Octomap, Path and transforms.

Sources: nav_msgs, sensor_msgs, geometry_msgs and tf2_msgs of ROS 2 Humble; octomap_msgs/Octomap and its conversions.h.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.transforms import rotations_to_quats
from ..core.types import FREE, OCCUPIED, Occupancy
from .map_server_files import CellGrid

FRAME = "map"
"""ROS's name of the frame of what is exported (REP 105)."""

OCTOMAP = "octomap_msgs/msg/Octomap"
_OCTOMAP = "std_msgs/Header header\nbool binary\nstring id\nfloat64 resolution\nint8[] data\n"

_CELLS = {FREE: 0, OCCUPIED: 100}  # others: -1
_POINT = np.dtype(
    [*((name, "<f4") for name in ("x", "y", "z")), ("rgb", "<u4"), ("probability", "<f4"), ("label", "<u2"),
     ("unused", "<u2"), ("size", "<f4")]
)  # fmt: skip
_FLOAT32, _UINT16 = 7, 4  # sensor_msgs/PointField
_FIELDS = {"x": _FLOAT32, "y": _FLOAT32, "z": _FLOAT32, "rgb": _FLOAT32, "probability": _FLOAT32, "label": _UINT16,
           "size": _FLOAT32}  # fmt: skip


@functools.cache
def load_types() -> Any:
    """The ``Typestore`` of rosbags with the messages of ROS 2 Humble and octomap_msgs."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    types = get_typestore(Stores.ROS2_HUMBLE)
    types.register(get_types_from_msg(_OCTOMAP, OCTOMAP))
    return types


def _new(kind: str, **fields: Any) -> Any:
    return load_types().types[kind](**fields)


def _header(seconds: float = 0.0, frame: str = FRAME) -> Any:
    """A stamp of 0 means that the message holds at any time."""
    nanoseconds = round(seconds * 1e9)
    stamp = _new("builtin_interfaces/msg/Time", sec=nanoseconds // 10**9, nanosec=nanoseconds % 10**9)
    return _new("std_msgs/msg/Header", stamp=stamp, frame_id=frame)


def _rotation(T: NDArray[np.float64]) -> Any:
    w, x, y, z = rotations_to_quats(T[None, :3, :3])[0].tolist()
    return _new("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)


def _pose(T: NDArray[np.float64]) -> Any:
    x, y, z = T[:3, 3].tolist()
    at = _new("geometry_msgs/msg/Point", x=x, y=y, z=z)
    return _new("geometry_msgs/msg/Pose", position=at, orientation=_rotation(T))


def make_grid(cells: NDArray[np.uint8], grid: CellGrid, floor_z: float) -> Any:
    """An OccupancyGrid of (X, Y) cells: 0 free, 100 occupied, -1 unknown, with the cells of the least y first."""
    values = np.full(256, -1, np.int8)
    values[list(_CELLS)] = list(_CELLS.values())
    T = np.eye(4)
    T[:3, 3] = *grid.origin, floor_z
    about = _new(
        "nav_msgs/msg/MapMetaData", map_load_time=_header().stamp, resolution=float(grid.size), width=grid.shape[0],
        height=grid.shape[1], origin=_pose(T),
    )  # fmt: skip
    return _new("nav_msgs/msg/OccupancyGrid", header=_header(), info=about, data=values[cells.T].reshape(-1))


def make_cloud(occupancy: Occupancy, labels: NDArray[np.uint8]) -> Any:
    """A PointCloud2 of the centers of the occupied voxels: x, y, z and size in meters, rgb, probability and label.
    labels: (V,) class of each voxel, 0 = none."""
    edges = occupancy.occupied_edges()
    centers = occupancy.centers(occupancy.occupied_voxels(), edges)
    points = np.zeros(len(centers), _POINT)
    for name, column in zip("xyz", centers.T, strict=True):
        points[name] = column
    red, green, blue = occupancy.colors.T.astype(np.uint32)
    points["rgb"] = red << 16 | green << 8 | blue
    points["probability"] = occupancy.probability[occupancy.state == OCCUPIED]
    points["label"], points["size"] = labels, edges * occupancy.finest
    fields = [
        _new("sensor_msgs/msg/PointField", name=name, offset=_offset(name), datatype=kind, count=1)
        for name, kind in _FIELDS.items()
    ]
    return _new(
        "sensor_msgs/msg/PointCloud2", header=_header(), height=1, width=len(points), fields=fields, is_bigendian=False,
        point_step=_POINT.itemsize, row_step=points.nbytes, data=points.view(np.uint8).reshape(-1), is_dense=True,
    )  # fmt: skip


def _offset(name: str) -> int:
    fields = _POINT.fields
    assert fields is not None
    return int(fields[name][1])


def make_octomap(nodes: bytes, resolution: float, frame: str) -> Any:
    """A binary Octomap, in a named frame, of the nodes of a .bt, which follow its line "data"."""
    data = np.frombuffer(nodes, np.int8)
    return _new(OCTOMAP, header=_header(frame=frame), binary=True, id="OcTree", resolution=float(resolution), data=data)


def make_transforms(frames: Mapping[str, NDArray[np.float64]]) -> Any:
    """A TFMessage of frames by name: each (4, 4) ``T_map_child``."""
    stamped = []
    for child, T_map_child in frames.items():
        x, y, z = T_map_child[:3, 3].tolist()
        moved = _new(
            "geometry_msgs/msg/Transform",
            translation=_new("geometry_msgs/msg/Vector3", x=x, y=y, z=z),
            rotation=_rotation(T_map_child),
        )
        stamped.append(
            _new("geometry_msgs/msg/TransformStamped", header=_header(), child_frame_id=child, transform=moved)
        )
    return _new("tf2_msgs/msg/TFMessage", transforms=stamped)


def make_path(T_map_cam: NDArray[np.float64], timestamps: NDArray[np.float64]) -> Any:
    """A Path of (N, 4, 4) camera poses: x right, y down, z forward."""
    poses = [
        _new("geometry_msgs/msg/PoseStamped", header=_header(seconds), pose=_pose(T))
        for T, seconds in zip(T_map_cam, timestamps.tolist(), strict=True)
    ]
    return _new("nav_msgs/msg/Path", header=_header(), poses=poses)


def make_text(text: str) -> Any:
    """A String."""
    return _new("std_msgs/msg/String", data=text)
