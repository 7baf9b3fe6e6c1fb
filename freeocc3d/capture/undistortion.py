"""Images of a lens with distortion as a pinhole camera without sees them, no larger than asked."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.types import Intrinsics
from .camera_files import reduced


@dataclass(frozen=True)
class Lens:
    """A camera and its distortion in OpenCV's order: k1 k2 p1 p2 and, where there are more, k3 k4 k5 k6; of a fisheye
    k1 k2 k3 k4. All zero, or none, is a pinhole camera."""

    camera: Intrinsics
    distortion: tuple[float, ...] = ()
    fisheye: bool = False


class Rectified:
    """Resamples images of a lens. What comes out has the lens's aspect ratio and holds seen pixels alone: of barrel
    distortion the corners are cut.

    intrinsics: of what comes out.
    """

    intrinsics: Intrinsics

    def __init__(self, lens: Lens, max_size: int | None):
        camera = reduced(lens.camera, max_size)
        self.size = camera.width, camera.height
        self.intrinsics = camera
        self._maps: tuple[NDArray[np.float32], NDArray[np.float32]] | None = None
        if lens.fisheye or any(lens.distortion):
            K = _pinhole(camera.matrix, lens, self.size)
            distortion = np.array(lens.distortion, np.float64)
            undistort = cv2.fisheye.initUndistortRectifyMap if lens.fisheye else cv2.initUndistortRectifyMap
            self._maps = undistort(camera.matrix, distortion, np.eye(3), K, self.size, cv2.CV_32FC1)
            self.intrinsics = Intrinsics(*self.size, K[0, 0], K[1, 1], K[0, 2], K[1, 2])

    def color(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """(H, W, 3) of the lens to (h, w, 3), areas averaged where it shrinks."""
        if image.shape[1::-1] != self.size:
            shrinks = image.shape[1] >= self.size[0]
            image = cv2.resize(image, self.size, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)
        return self._moved(image, cv2.INTER_LINEAR, cv2.BORDER_REPLICATE)

    def depth(self, depth_m: NDArray[np.float32]) -> NDArray[np.float32]:
        """(H, W) metres of the lens, of any size, to (h, w); each pixel has the depth measured nearest to it."""
        if depth_m.shape[1::-1] != self.size:
            depth_m = cv2.resize(depth_m, self.size, interpolation=cv2.INTER_NEAREST_EXACT)
        return self._moved(depth_m, cv2.INTER_NEAREST, cv2.BORDER_CONSTANT)

    def _moved(self, image: NDArray[Any], by: int, border: int) -> NDArray[Any]:
        return image if self._maps is None else cv2.remap(image, *self._maps, by, borderMode=border)


def _pinhole(K: NDArray[np.float64], lens: Lens, size: tuple[int, int]) -> NDArray[np.float64]:
    """The camera matrix of an image of the same size that shows nothing beyond the lens's."""
    distortion = np.array(lens.distortion, np.float64)
    if lens.fisheye:
        return np.asarray(
            cv2.fisheye.estimateNewCameraMatrixForUndistortRectify(K, distortion, size, np.eye(3), balance=0.0)
        )
    return np.asarray(cv2.getOptimalNewCameraMatrix(K, distortion, size, 0)[0])
