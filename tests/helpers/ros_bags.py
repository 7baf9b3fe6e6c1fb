"""Writes small ROS bags with the package rosbags."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from rosbags import rosbag1, rosbag2
from rosbags.rosbag2 import StoragePlugin

from freeocc3d.capture.ros.message_types import load_types
from freeocc3d.core.transforms import rotations_to_quats

Kind = Literal["bag", "db3", "mcap"]

Sent = tuple[str, int, Any]
"""Topic, time of recording in nanoseconds, message."""

COLOR, DEPTH = "/camera/color/image_raw", "/camera/depth/image_rect_raw"
START_S = 1_700_000_000


class Messages:
    """Makes the messages of ROS 1 (bag) or ROS 2 (db3, mcap)."""

    def __init__(self, kind: Kind):
        self.kind = kind
        self.store = load_types(kind == "bag")
        self._types = self.store.types

    def header(self, seconds: float, frame: str) -> Any:
        nanoseconds = round(seconds * 1e9)
        stamp = self._types["builtin_interfaces/msg/Time"](sec=nanoseconds // 10**9, nanosec=nanoseconds % 10**9)
        more = {"seq": 0} if self.kind == "bag" else {}
        return self._types["std_msgs/msg/Header"](stamp=stamp, frame_id=frame, **more)

    def image(self, image: NDArray[Any], encoding: str, seconds: float, frame: str = "camera", pad: int = 0) -> Any:
        """A raw image. pad: bytes after each row."""
        rows = np.ascontiguousarray(image).view(np.uint8).reshape(image.shape[0], -1)
        rows = np.pad(rows, ((0, 0), (0, pad)))
        return self._types["sensor_msgs/msg/Image"](
            header=self.header(seconds, frame), height=image.shape[0], width=image.shape[1], encoding=encoding,
            is_bigendian=int(image.dtype.byteorder == ">"), step=rows.shape[1], data=rows.reshape(-1),
        )  # fmt: skip

    def compressed(self, data: bytes, form: str, seconds: float, frame: str = "camera") -> Any:
        return self._types["sensor_msgs/msg/CompressedImage"](
            header=self.header(seconds, frame), format=form, data=np.frombuffer(data, np.uint8)
        )

    def info(
        self, size: tuple[int, int], K: Sequence[float], D: Sequence[float] = (), model: str = "plumb_bob",
        P: Sequence[float] | None = None, frame: str = "camera", **changed: Any,
    ) -> Any:  # fmt: skip
        """CameraInfo. K, P: fx, fy, cx, cy."""
        roi = self._types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
        fx, fy, cx, cy = K
        px, py, pcx, pcy = P or K
        values: dict[str, Any] = {
            "D": np.array(D, np.float64), "K": np.array((fx, 0, cx, 0, fy, cy, 0, 0, 1.0)),
            "R": np.eye(3).reshape(-1), "P": np.array((px, 0, pcx, 0, 0, py, pcy, 0, 0, 0, 1.0, 0)),
        }  # fmt: skip
        if self.kind != "bag":
            values = {name.lower(): value for name, value in values.items()}
        return self._types["sensor_msgs/msg/CameraInfo"](
            **{
                "header": self.header(START_S, frame), "height": size[1], "width": size[0], "distortion_model": model,
                "binning_x": 0, "binning_y": 0, "roi": roi, **values, **changed,
            }
        )  # fmt: skip

    def transforms(self, *edges: tuple[str, str, NDArray[np.float64]]) -> Any:
        """A TFMessage of (parent, child, (4, 4) T_parent_child)."""
        types = self._types
        found = []
        for parent, child, T in edges:
            w, x, y, z = rotations_to_quats(T[None, :3, :3])[0].tolist()
            moved = types["geometry_msgs/msg/Transform"](
                translation=types["geometry_msgs/msg/Vector3"](*T[:3, 3].tolist()),
                rotation=types["geometry_msgs/msg/Quaternion"](x=x, y=y, z=z, w=w),
            )
            found.append(
                types["geometry_msgs/msg/TransformStamped"](
                    header=self.header(START_S, parent), child_frame_id=child, transform=moved
                )
            )
        return types["tf2_msgs/msg/TFMessage"](transforms=found)

    def text(self, text: str) -> Any:
        return self._types["std_msgs/msg/String"](data=text)


def write_bag(path: Path, messages: Messages, sent: Sequence[Sent], compression: str = "") -> Path:
    """Write messages in the order given. Returns the .bag file, or the folder of ROS 2. compression: of chunks ("lz4",
    "bz2"; "zstd" for mcap), or "message"."""
    store = messages.store
    if messages.kind == "bag":
        bag = rosbag1.Writer(path)
        if compression:
            bag.set_compression(getattr(rosbag1.Writer.CompressionFormat, compression.upper()))
        serialize = store.serialize_ros1
    else:
        plugin = StoragePlugin.MCAP if messages.kind == "mcap" else StoragePlugin.SQLITE3
        bag = rosbag2.Writer(path, version=9, storage_plugin=plugin)
        if compression:
            mode = rosbag2.CompressionMode.MESSAGE if compression == "message" else rosbag2.CompressionMode.STORAGE
            bag.set_compression(mode, rosbag2.CompressionFormat.ZSTD)
        serialize = store.serialize_cdr
    with bag:
        connections: dict[str, Any] = {}
        for topic, time, message in sent:
            if topic not in connections:
                connections[topic] = bag.add_connection(topic, message.__msgtype__, typestore=store)
            bag.write(connections[topic], time, serialize(message, message.__msgtype__))
    return path


def stored_file(bag: Path) -> Path:
    """The one .db3 or .mcap of a folder of ROS 2."""
    return next(path for path in sorted(bag.iterdir()) if path.suffix in (".db3", ".mcap"))


def encode(image: NDArray[Any], suffix: str) -> bytes:
    """A PNG or JPEG of RGB or 16-bit gray."""
    ordered = image[..., ::-1] if image.ndim == 3 else image
    return bytes(cv2.imencode(suffix, np.ascontiguousarray(ordered))[1])
