"""Corrects a capture whose color camera has another focal length than its files state."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.types import Frame, Intrinsics
from .base import Capture
from .cameras.depth_registration import PixelGrid


class Reregistered(Capture):
    """``capture`` with color and class images resampled to the depth image's pixels, for a color camera at the same
    place with ``color_focal`` times the depth camera's focal length. Depth, poses and intrinsics stay unchanged."""

    def __init__(self, capture: Capture, color_focal: float):
        super().__init__(capture.path, capture.options)
        self.format, self.layout = capture.format, capture.layout  # type: ignore[misc]
        self.timestamps, self.classes = capture.timestamps, capture.classes
        self.color_focal = color_focal
        self._capture = capture
        self._grids: dict[Intrinsics, PixelGrid] = {}

    @classmethod
    def recognizes(cls, path: object) -> bool:
        return False

    def __getitem__(self, index: int) -> Frame:
        frame = self._capture[index]
        grid = self._grid(frame.intrinsics)
        return replace(frame, color=grid.color(frame.color), depth_m=grid.depth(frame.depth_m))

    def raw_depth(self, index: int) -> tuple[NDArray[Any], float] | None:
        return self._capture.raw_depth(index)

    def name(self, index: int) -> str:
        return self._capture.name(index)

    def turned(self, index: int) -> int:
        return self._capture.turned(index)

    def pose(self, index: int) -> NDArray[np.float64] | None:
        return self._capture.pose(index)

    def labels(self, index: int) -> NDArray[np.uint8] | None:
        labels = self._capture.labels(index)
        return None if labels is None else self._grid(self._capture[index].intrinsics).classes(labels)

    def _grid(self, camera: Intrinsics) -> PixelGrid:
        if camera not in self._grids:
            color = replace(camera, fx=camera.fx * self.color_focal, fy=camera.fy * self.color_focal)
            self._grids[camera] = PixelGrid(color, camera)
        return self._grids[camera]
