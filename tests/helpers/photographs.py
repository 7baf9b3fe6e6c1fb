"""A capture of color images alone, for the tests of structure from motion."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from freeocc3d.capture import open_capture
from freeocc3d.capture.base import Capture, Options
from freeocc3d.core.types import Frame, Intrinsics


class Photographs(Capture):
    """Images in memory, all by one camera."""

    format, layout, has_depth = "photographs", "none", False

    def __init__(self, images: Sequence[NDArray[np.uint8]], camera: Intrinsics, known: bool = True):
        super().__init__(Path("photographs"), Options())
        self.images, self.camera, self.intrinsics_known = images, camera, known
        self.timestamps = np.arange(len(images), dtype=np.float64)

    @classmethod
    def recognizes(cls, path: Path) -> bool:
        return False

    def __getitem__(self, index: int) -> Frame:
        color = self.images[index]
        return Frame(index, float(index), color, np.zeros(color.shape[:2], np.float32), self.camera)

    def name(self, index: int) -> str:
        return f"photo_{index:03d}.jpg"


@functools.cache
def walk(count: int = 16, frames: int = 60) -> tuple[tuple[NDArray[np.uint8], ...], NDArray[np.float64], Intrinsics]:
    """Images of the first ``count`` of ``frames`` on the walk through the built-in room, their poses, the camera."""
    room = open_capture("builtin:room", Options(), {"synthetic": {"frames": frames}})
    images = tuple(room[index].color for index in range(count))
    return images, np.stack([room.pose(index) for index in range(count)]), room[0].intrinsics


@functools.cache
def turning(count: int = 12) -> tuple[tuple[NDArray[np.uint8], ...], Intrinsics]:
    """Images of a camera that turns on the spot, which are parts of one large picture, and the camera."""
    large = open_capture("builtin:room", Options(), {"synthetic": {"frames": 60, "width": 1280, "height": 960}})[0]
    focal = large.intrinsics.fx / 2
    camera = Intrinsics(320, 240, focal, focal, 159.5, 119.5)  # half the picture's angle
    images = []
    for angle in np.deg2rad(np.linspace(-8, 8, count)):
        turn, _ = cv2.Rodrigues(np.array([0.3 * angle, angle, 0.0]))
        to_large = large.intrinsics.matrix @ turn @ np.linalg.inv(camera.matrix)
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        images.append(cv2.warpPerspective(large.color, to_large, (camera.width, camera.height), flags=flags))
    return tuple(images), camera
