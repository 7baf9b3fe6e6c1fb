"""Reads ROS bags: .bag of ROS 1 and of RealSense's recorder, .mcap, .db3 and folders of ROS 2.

Topics are found by type: color is an Image or CompressedImage, depth an Image of 16UC1 (millimeters) or 32FC1 (meters),
or compressedDepth. CameraInfo gives the cameras, /tf_static where the depth camera is. Opening reads the index and the
times in the messages' headers; without an index, and where chunks are compressed, it passes through the file once.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.errors import CaptureError, FrameError
from ...core.warnings import Notice
from ...settings.typed_options import TypedOptions
from .. import base
from ..cameras.camera_files import is_pose
from ..cameras.lenses import Lens
from ..cameras.rigs import Rig, StatedCameras, build_rig
from ..files.file_bytes import DamagedFile
from ..files.time_pairs import pair_streams
from ..images.depth_decoding import METERS, MILLIMETERS, RawDepth
from ..rgbd_frames import Registration, RgbdFrames
from ..ros import stores
from ..ros.camera_messages import FrameTree, lens_of_info, transform_matrix
from ..ros.frame_paths import FramePaths
from ..ros.image_messages import decode_color, decode_depth, describe_image
from ..ros.message_store import Messages, Place
from ..ros.message_types import deserialize
from ..ros.topics import IMAGE_TYPES, INFO_TYPE, TF_TYPES, ImageTopic, choose_color, choose_depth, find_info

REQUIRES: tuple[str, ...] = ("rosbags",)

_STAMP = np.dtype([("before", "V4"), ("seconds", "<u4"), ("nanoseconds", "<u4")])
"""First bytes of a message with a header: its number (ROS 1) or CDR's form (ROS 2), and its time."""
_BIG_ENDIAN_FORMS = (0, 2)
_TRIES, _MOST_TRANSFORMS, _MOST_POSES = 5, 1000, 2_000_000

_REALSENSE_UNITS = re.compile(r"/device_\d+/sensor_\d+/option/Depth[ _]Units/value")
_REALSENSE_PLACE = "/tf/0"


class Options(TypedOptions, frozen=True):
    """Which cameras."""

    color_topic: str | None = None
    """Topic of the color images; null = the only one, or the best."""
    depth_topic: str | None = None
    """Topic of the depth images; null = the one that goes with the color, aligned to it if there is such a topic."""


class Reader(RgbdFrames):
    """A frame is a color message and the depth message that is nearest in time, by the stamps in their headers.
    Messages without a partner within half an interval are left out. Depth is registered to the color camera."""

    format = "ros_bag"
    layout = "a ROS bag: a .bag, .mcap or .db3 file, or a folder of such with metadata.yaml"
    reads_files = True

    def __init__(self, path: Path, options: base.Options, own: Options | None = None):
        own = own or Options()
        self._store, self._source = stores.open_store(path), path
        topics = self._image_topics(path)
        color = choose_color(topics, own.color_topic, path)
        depth = choose_depth(topics, own.depth_topic, color, path) if options.depth else None
        self._topics = (color, depth)
        self._messages = [self._find(topic.name) if topic else None for topic in self._topics]
        times, self._rows, self.warnings = self._pair_messages(path)
        super().__init__(path, options, times, self._units(depth))
        self.has_depth = depth is not None
        stated = self._stated_cameras(color, depth)
        sizes = color.kind.size, depth.kind.size if depth else None
        self._rig, self.intrinsics_known = build_rig(stated, options, *sizes)
        self.focal_stated = self.intrinsics_known
        Registration(self._rig)  # raises CaptureError for a rig of too large images

    @classmethod
    def recognizes(cls, path: Path) -> bool:
        return stores.is_bag(path)

    def stored_color(self, index: int) -> NDArray[np.uint8]:
        return decode_color(*self._read_frame(index, 0))

    def stored_depth(self, index: int) -> RawDepth | None:
        return decode_depth(*self._read_frame(index, 1))

    def rig(self, index: int) -> Rig:
        return self._rig

    def _read_frame(self, index: int, stream: int) -> tuple[Any, str]:
        """The message of a frame in the color (0) or depth (1) stream, and what it is in words. Raises FrameError."""
        topic, messages = self._topics[stream], self._messages[stream]
        assert topic is not None
        assert messages is not None
        row = int(self._rows[index, stream])
        what = f"Message {row} of {topic.name} in {self.path}"
        try:
            return self._message(topic.name, messages.place(row)), what
        except (DamagedFile, OSError) as error:
            raise FrameError(f"{what} cannot be read: {error}.") from error

    def _find(self, topic: str) -> Messages:
        try:
            return self._store.find(topic)
        except (DamagedFile, OSError) as error:
            raise CaptureError(f"{self._source} is not a readable ROS bag: {error}.") from error

    def _message(self, topic: str, place: Place) -> Any:
        """A message. Raises DamagedFile, OSError."""
        data = self._store.read(place)
        try:
            return deserialize(data, self._store.topics[topic], self._store.ros1)
        except Exception as error:  # the generated code checks nothing
            raise DamagedFile("it is damaged: the message does not fit its type") from error

    def _some(self, topic: str, most: int) -> list[Any]:
        """The first messages of a topic, without those that are damaged."""
        found, messages = [], self._find(topic)
        for row in range(min(most, len(messages))):
            try:
                found.append(self._message(topic, messages.place(row)))
            except (DamagedFile, OSError):
                continue
        return found

    def _image_topics(self, path: Path) -> list[ImageTopic]:
        found = []
        for name in sorted(name for name, kind in self._store.topics.items() if kind in IMAGE_TYPES):
            for message in self._some(name, _TRIES):
                try:
                    found.append(ImageTopic(name, describe_image(message, f"{name} in {path}")))
                    break
                except FrameError:
                    continue
        return found

    def _pair_messages(self, path: Path) -> tuple[NDArray[np.float64], NDArray[np.int64], tuple[Notice, ...]]:
        """(N,) seconds, (N, 2) rows of the color and depth messages of frames, and warnings. Raises CaptureError."""
        color, depth = self._messages
        assert color is not None
        a, order_a = _ascending(self._stamps(color))
        if depth is None:
            return a, np.column_stack((order_a, order_a)), ()
        b, order_b = _ascending(self._stamps(depth))
        received = color.times[order_a] * 1e-9, depth.times[order_b] * 1e-9
        pairs, notices = pair_streams(path, (a, b), received)
        rows = np.column_stack((order_a[pairs[:, 0]], order_b[pairs[:, 1]]))
        return a[pairs[:, 0]], rows, notices

    def _stamps(self, messages: Messages) -> NDArray[np.float64]:
        """(N,) seconds of messages, from their headers; the time of recording where a header has none."""
        try:
            heads = np.ascontiguousarray(self._store.heads(messages, _STAMP.itemsize))
        except (DamagedFile, OSError) as error:
            raise CaptureError(f"{self._source} is not a readable ROS bag: {error}.") from error
        stamps = heads.view(_STAMP)[:, 0]
        if not self._store.ros1 and len(heads) and heads[0, 1] in _BIG_ENDIAN_FORMS:
            stamps = heads.view(_STAMP.newbyteorder())[:, 0]
        seconds = stamps["seconds"] + stamps["nanoseconds"] * 1e-9
        return np.where(seconds > 0, seconds, messages.times * 1e-9)

    def _units(self, depth: ImageTopic | None) -> float:
        """Units per meter of the depth: what RealSense's recorder states, or those of the encoding."""
        if depth is None or depth.kind.encoding == "32FC1":
            return METERS
        device = depth.name.partition("/sensor_")[0] + "/"
        for name in self._store.topics:
            if _REALSENSE_UNITS.fullmatch(name) and name.startswith(device):
                meters = [float(message.data) for message in self._some(name, 1)]
                if meters and 1e-6 <= meters[0] <= 1:
                    return round(1 / meters[0], 2)
        return MILLIMETERS

    def _stated_cameras(self, color: ImageTopic, depth: ImageTopic | None) -> StatedCameras:
        infos = {name: self._some(name, 1) for name, kind in self._store.topics.items() if kind == INFO_TYPE}
        frames = {name: str(found[0].header.frame_id).lstrip("/") for name, found in infos.items() if found}

        def lens(topic: ImageTopic) -> Lens | None:
            name = find_info(topic, frames)
            if name is None:
                return None
            return lens_of_info(infos[name][0], topic.kind.size, topic.rectified, f"{name} in {self._source}")

        if depth is None:
            return StatedCameras(lens(color))
        return StatedCameras(lens(color), lens(depth), self._find_T_color_depth(color, depth))

    def _find_T_color_depth(self, color: ImageTopic, depth: ImageTopic) -> NDArray[np.float64] | None:
        """(4, 4) depth to color camera frame; None if the two coincide, or nothing says where they are."""
        placed = [topic.namespace.rpartition("/")[0] + _REALSENSE_PLACE for topic in (color, depth)]
        if all(name in self._store.topics for name in placed):  # T_stream_reference of RealSense's recorder
            T_color, T_depth = (next(map(transform_matrix, self._some(name, 1)), None) for name in placed)
            return None if T_color is None or T_depth is None else T_color @ np.linalg.inv(T_depth)
        frames = color.kind.frame_id, depth.kind.frame_id
        if frames[0] == frames[1] or not all(frames):
            return None
        tree = FrameTree()
        for name in self._transform_topics():
            tree.add(self._some(name, _MOST_TRANSFORMS))
        T_color_depth = tree.find(*frames)
        if T_color_depth is None:
            T_color_depth = self._stated_extrinsics(color)
        if T_color_depth is None:
            text = (
                f"{self._source} holds color of the frame {frames[0]} and depth of the frame {frames[1]}, but nothing "
                "says where the two are: they are taken as one. Record /tf_static, or aligned_depth_to_color."
            )
            self.warnings = (*self.warnings, Notice("extrinsics-unknown", text))
        return T_color_depth

    def _transform_topics(self) -> list[str]:
        """The topics of tf, those of fixed transforms first."""
        names = [name for name, kind in self._store.topics.items() if kind in TF_TYPES]
        return sorted(names, key=lambda name: (not name.endswith("static"), name))

    def _stated_extrinsics(self, color: ImageTopic) -> NDArray[np.float64] | None:
        """(4, 4) T_color_depth of realsense-ros's message Extrinsics, whose last fields are a rotation by columns and a
        translation; None if there is none."""
        names = [name for name in self._store.topics if name.endswith("extrinsics/depth_to_color")]
        for name in (name for name in names if name.split("/")[1] == color.name.split("/")[1]):
            found = self._find(name)
            try:
                values = np.frombuffer(self._store.read(found.place(0))[-96:], "<f8") if len(found) else np.zeros(0)
            except (DamagedFile, OSError, ValueError):
                continue
            T = np.eye(4)
            if len(values) == 12:
                T[:3, :3], T[:3, 3] = values[:9].reshape(3, 3).T, values[9:]
                if is_pose(T):
                    return T
        return None

    def pose(self, index: int) -> NDArray[np.float64] | None:
        """(4, 4) T_root_color at the time of the color image, where tf has a chain of frames that moves."""
        return self._paths.pose(self._topics[0].kind.frame_id, float(self.timestamps[index]))

    @functools.cached_property
    def _paths(self) -> FramePaths:
        def transforms() -> Iterator[tuple[Any, bool]]:
            for name in self._transform_topics():
                static = name.endswith("static")
                yield from ((message, static) for message in self._some(name, _MOST_POSES))

        return FramePaths(transforms())


def _ascending(times: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Times, ascending and each once, and their rows."""
    found, rows = np.unique(times, return_index=True)
    return found, rows.astype(np.int64)
