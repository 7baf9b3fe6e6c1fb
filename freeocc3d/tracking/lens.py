"""A camera with a lens that distorts, and its images as a pinhole camera would have taken them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from ..types import Intrinsics


@dataclass(frozen=True)
class LensCamera:
    """intrinsics: of the image as it was taken.  distortion: k1, k2, p1, p2 of OpenCV's model; all 0 = none."""

    intrinsics: Intrinsics
    distortion: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)

    @property
    def distorts(self) -> bool:
        """Whether undistorted images differ from those taken."""
        return any(self.distortion)

    @cached_property
    def _pinhole(self) -> Intrinsics:
        size = self.intrinsics.width, self.intrinsics.height
        K, _ = cv2.getOptimalNewCameraMatrix(self.intrinsics.matrix, np.array(self.distortion), size, alpha=0)
        return Intrinsics(*size, float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2]))

    @cached_property
    def _maps(self) -> tuple[NDArray[np.int16], NDArray[np.uint16]]:
        to = self.pinhole()
        maps = cv2.initUndistortRectifyMap(
            self.intrinsics.matrix, np.array(self.distortion), None, to.matrix, (to.width, to.height), cv2.CV_16SC2
        )
        return maps[0], maps[1]

    def pinhole(self) -> Intrinsics:
        """The camera of undistorted images: of the same size, and no pixel of theirs lies outside of those taken."""
        return self._pinhole if self.distorts else self.intrinsics

    def undistorted(self, color: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """(H, W, 3) as the pinhole camera would have taken it; without distortion the image itself."""
        return cv2.remap(color, *self._maps, cv2.INTER_LINEAR) if self.distorts else color
