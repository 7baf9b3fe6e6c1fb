"""Chooses the topics of color and depth, and finds what else a bag says about them by the topics' names.

Sources: image_pipeline's and realsense-ros's topics; librealsense's ros_file_format.h for bags of its own recorder.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass

from ...core.errors import CaptureError
from .image_messages import ImageKind

IMAGE_TYPES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
INFO_TYPE = "sensor_msgs/msg/CameraInfo"
TF_TYPES = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")

_TRANSPORT = re.compile(r"/(?:compressed|compressedDepth|compressed_depth|zstd|ffmpeg|theora)$")
_RECTIFIED = re.compile(r"(?:^|[_/])rect(?:ified)?(?:[_/]|$)")
_OTHER_EYES = re.compile(r"infra|(?:^|[_/])ir\d?(?:[_/]|$)|fisheye|thermal|confidence|mask|segment|debug|result")


@dataclass(frozen=True)
class ImageTopic:
    """A topic of images and what its first message is."""

    name: str
    kind: ImageKind

    @property
    def base(self) -> str:
        """The topic without what names its compression."""
        return _TRANSPORT.sub("", self.name)

    @property
    def namespace(self) -> str:
        """The part of the topic that its camera_info shares."""
        return self.base.rpartition("/")[0]

    @property
    def rectified(self) -> bool:
        """Whether the topic's name says that the images are undistorted."""
        return _RECTIFIED.search(self.base.rpartition("/")[2]) is not None


def choose_color(topics: list[ImageTopic], wanted: str | None, path: object) -> ImageTopic:
    """The topic of color. wanted: a topic that the user names. Raises CaptureError if there is none, or no best."""
    found = [topic for topic in topics if topic.kind.is_color and not topic.kind.is_depth(topic.name)]
    if wanted is not None:
        return _named(found, wanted, "color", path)
    if not found:
        raise CaptureError(
            f"{path} holds no color images of a kind that is read{_listed(topics)}. Give a bag with "
            "sensor_msgs/Image or CompressedImage."
        )
    return _best({topic: _rank_color(topic) for topic in found}, "color", path)


def choose_depth(topics: list[ImageTopic], wanted: str | None, color: ImageTopic, path: object) -> ImageTopic | None:
    """The topic of depth that goes with a color topic; None if there is none. Raises CaptureError if several fit."""
    found = [topic for topic in topics if topic.kind.is_depth(topic.name)]
    if wanted is not None:
        return _named(found, wanted, "depth", path)
    return _best({topic: _rank_depth(topic, color) for topic in found}, "depth", path) if found else None


def find_info(topic: ImageTopic, infos: Mapping[str, str]) -> str | None:
    """The topic of the camera of an image topic. infos: topic -> frame of its first message."""
    for name in (f"{topic.namespace}/camera_info", f"{topic.namespace.rpartition('/')[0]}/info/camera_info"):
        if name in infos:
            return name
    frame = topic.kind.frame_id
    same = sorted(name for name, other in infos.items() if frame and other == frame)
    return same[0] if same else None


def _named(found: list[ImageTopic], wanted: str, what: str, path: object) -> ImageTopic:
    for topic in found:
        if topic.name.strip("/") == wanted.strip("/"):
            return topic
    raise CaptureError(
        f"{path} holds no {what} images of the topic {wanted}: {_listed(found).strip(' ()') or 'it has none at all'}. "
        f"Correct capture.ros_bag.{what}_topic."
    )


def _rank_color(topic: ImageTopic) -> tuple[int, ...]:
    other = _OTHER_EYES.search(topic.name.lower()) is not None
    return (not other, not topic.kind.is_gray, "depth" not in topic.name.lower())


def _rank_depth(topic: ImageTopic, color: ImageTopic) -> tuple[int, ...]:
    name = topic.name.lower()
    aligned = 2 if "aligned_depth_to_color" in name else 1 if "depth_registered" in name or "rgb" in name else 0
    same_device = _device(topic) == _device(color)
    return (same_device, _OTHER_EYES.search(name) is None, aligned)


def _device(topic: ImageTopic) -> str:
    return topic.name.strip("/").partition("/")[0]


def _best(ranks: dict[ImageTopic, tuple[int, ...]], what: str, path: object) -> ImageTopic:
    """The topic of the highest rank. Of one camera, rectified images win, then raw ones. Raises CaptureError."""
    highest = max(ranks.values())
    cameras: dict[str, list[ImageTopic]] = {}
    for topic, rank in ranks.items():
        if rank == highest:
            cameras.setdefault(topic.namespace, []).append(topic)
    if len(cameras) > 1:
        names = sorted(_preferred(topics).name for topics in cameras.values())
        raise CaptureError(
            f"{path} holds {what} images of {len(names)} cameras: {', '.join(names)}. Choose one with --set "
            f"capture.ros_bag.{what}_topic={names[0]}."
        )
    return _preferred(next(iter(cameras.values())))


def _preferred(topics: list[ImageTopic]) -> ImageTopic:
    return max(
        sorted(topics, key=lambda t: t.name), key=lambda t: (t.rectified, not t.kind.is_gray, t.kind.form == "raw")
    )


def _listed(topics: list[ImageTopic]) -> str:
    named = [f"{topic.name} ({topic.kind.encoding or 'compressed'})" for topic in topics]
    return f" (it has {', '.join(named[:12])})" if named else ""
