"""Frames of a color and a depth camera from any source: undistorted, registered to one pixel grid, in meters.

A reader of such a format gives stored images and the cameras that took them; the rest is the same for all formats.
"""

from __future__ import annotations

import functools
from abc import abstractmethod
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.depth_sensors import AUTO, TIME_OF_FLIGHT, find_sensor
from ..core.errors import CaptureError, FrameError
from ..core.types import Frame, Intrinsics
from .base import Capture, Options
from .cameras.depth_registration import PixelGrid
from .cameras.rigs import Rig
from .cameras.undistortion import Rectified
from .images.depth_decoding import RawDepth, convert_to_meters, usual_units

MOST_FRAME_PIXELS = 1 << 25
"""Largest frame: that of an 8K video. A run keeps several frames in memory, with 7 bytes per pixel."""

UNSURE_SIGMA = 2.0
"""A depth of medium confidence has this many times the sensor's standard deviation."""


class Registration:
    """Undistorts the images of a rig and brings them to one pixel grid: that of the depth, or of the smaller image if
    the two cameras are apart (see ``depth_registration``). intrinsics: of the result."""

    intrinsics: Intrinsics

    def __init__(self, rig: Rig):
        self._color, self._depth = Rectified(rig.color, None), Rectified(rig.depth, None)
        T_color_depth = None if rig.T_color_depth is None else np.array(rig.T_color_depth)
        self.grid = PixelGrid(self._color.intrinsics, self._depth.intrinsics, T_color_depth)
        self.intrinsics = self.grid.intrinsics
        if self.intrinsics.width * self.intrinsics.height > MOST_FRAME_PIXELS:
            raise CaptureError(
                f"Frames of {self.intrinsics.width} x {self.intrinsics.height} pixels are too large: at most "
                f"{MOST_FRAME_PIXELS / 1e6:.0f} million pixels are possible. Reduce the images."
            )

    def color(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Stored color (H, W, 3) on the grid (h, w, 3)."""
        return self.grid.color(self._color.color(image))

    def classes(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """A stored class image (H, W) of the color camera on the grid (h, w)."""
        return self.grid.classes(self._color.nearest(image))

    def depth(self, depth_m: NDArray[np.float32]) -> NDArray[np.float32]:
        """Stored depth (H, W), meters, on the grid (h, w). May change its argument."""
        return self.grid.depth(self._depth.depth(depth_m))


class RgbdFrames(Capture):
    """Frames of which a reader gives the stored images and the rig."""

    units_stated: bool = True
    """Whether the format, its files or the user state the unit of the depth."""

    def __init__(self, path: Path, options: Options, timestamps: NDArray[np.float64], units_per_meter: float | None):
        """timestamps: (N,) seconds, ascending.  units_per_meter: of the stored depth; None = nothing states it.
        ``capture.depth_scale`` replaces it."""
        super().__init__(path, options)
        self.timestamps = timestamps
        self.has_depth = options.depth
        self.units_per_meter = options.depth_scale or units_per_meter
        self.units_stated = self.units_per_meter is not None
        self._registration = functools.lru_cache(maxsize=4)(Registration)

    @abstractmethod
    def stored_color(self, index: int) -> NDArray[np.uint8]:
        """(H, W, 3) RGB as stored. Raises FrameError."""

    @abstractmethod
    def stored_depth(self, index: int) -> RawDepth | None:
        """(H, W) depth as stored; None if the frame has none. Raises FrameError."""

    def stored_confidence(self, index: int) -> NDArray[np.uint8] | None:
        """(h, w) confidence of the depth: 0 = low, 1 = medium, 2 = high; None = all are high. Raises FrameError."""
        return None

    @abstractmethod
    def rig(self, index: int) -> Rig:
        """The cameras of the frame's stored images."""

    def __getitem__(self, index: int) -> Frame:
        if not 0 <= index < len(self):
            raise IndexError(f"Frame {index} of a capture of {len(self)} frames.")
        registration = self.registration(index)
        color = self.stored_color(index)
        _check_size(color, self.rig(index).color.camera, f"The color of frame {index} of {self.path}")
        color = registration.color(color)
        raw = self.stored_depth(index) if self.has_depth else None
        if raw is None:
            depth_m, sigma_m = np.zeros(color.shape[:2], np.float32), None
        else:
            depth_m, sigma_m = self._measured(index, raw, registration)
        return Frame(index, float(self.timestamps[index]), color, depth_m, registration.intrinsics, sigma_m)

    def raw_depth(self, index: int) -> tuple[RawDepth, float] | None:
        raw = self.stored_depth(index) if self.has_depth else None
        return None if raw is None else (raw, self.units_per_meter or usual_units(raw))

    def registration(self, index: int) -> Registration:
        """What brings the frame's stored images to one pixel grid. Raises FrameError for a rig that is not usable."""
        try:
            return self._registration(self.rig(index))
        except CaptureError as error:
            raise FrameError(f"Frame {index} of {self.path} cannot be undistorted: {error}") from error

    def _measured(
        self, index: int, raw: RawDepth, registration: Registration
    ) -> tuple[NDArray[np.float32], NDArray[np.float32] | None]:
        """Depth, and its standard deviation where confidence tells, on the grid, meters."""
        _check_size(raw, self.rig(index).depth.camera, f"The depth of frame {index} of {self.path}")
        depth_m = convert_to_meters(raw, self.units_per_meter or usual_units(raw), self.options.max_depth)
        confidence = self.stored_confidence(index)
        if confidence is None or confidence.min(initial=2) >= 2:
            return registration.depth(depth_m), None
        if confidence.shape != depth_m.shape:
            confidence = cv2.resize(confidence, depth_m.shape[::-1], interpolation=cv2.INTER_NEAREST_EXACT)
        depth_m *= confidence != 0
        unsure = registration.depth(depth_m * (confidence == 1)) > 0
        depth_m = registration.depth(depth_m)
        times = unsure * np.float32(UNSURE_SIGMA - 1.0) + np.float32(1.0)
        # confidence comes from the LiDAR of phones
        sensor = TIME_OF_FLIGHT if self.options.sensor == AUTO else find_sensor(self.options.sensor)
        return depth_m, times * sensor.compute_sigma(depth_m)


def _check_size(image: NDArray[Any], camera: Intrinsics, what: str) -> None:
    if image.shape[1::-1] != (camera.width, camera.height):
        raise FrameError(
            f"{what} has {image.shape[1]} x {image.shape[0]} pixels, but its camera has {camera.width} x "
            f"{camera.height}."
        )


def normalize_confidence(stored: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Confidence of 0, 1, 2 (ARKit), 0, 50, 100 (RTAB-Map) or 0, 127, 255 (Polycam) as 0, 1, 2."""
    largest = int(stored.max(initial=0))
    step = 1 if largest <= 2 else 50 if largest <= 100 else 127
    return cv2.LUT(stored, np.minimum((np.arange(256) + step // 3) // step, 2).astype(np.uint8))
