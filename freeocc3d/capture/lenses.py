"""Represents the camera models of COLMAP, OpenCV and nerfstudio as one type, and undistorts images.

Sources: COLMAP's "Camera models", nerfstudio's "Data conventions", OpenCV's "Camera calibration and 3D reconstruction"
and "Fisheye camera model". The radial models of all three are OpenCV's.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.errors import CaptureError
from ..core.types import Intrinsics
from .camera_files import check_focal, reduce_camera

PINHOLE_MODELS = ("SIMPLE_PINHOLE", "PINHOLE")
BROWN_MODELS = ("SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV")
"""Radial and tangential distortion. Each model has some of the eight coefficients, or all."""
FISHEYE_MODELS = ("SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "OPENCV_FISHEYE")
MODELS = (*PINHOLE_MODELS, *BROWN_MODELS, *FISHEYE_MODELS)

_BROWN_ORDER = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
_BROWN_COUNTS = (0, 4, 5, 8)  # numbers of coefficients that OpenCV accepts
_FISHEYE_ORDER = ("k1", "k2", "k3", "k4")


@dataclass(frozen=True)
class Lens:
    """A camera and its distortion, in OpenCV's order: k1 k2 p1 p2, then k3 k4 k5 k6 if used; for a fisheye k1 k2 k3 k4.
    Without coefficients, or with all zero, it is a pinhole camera, unless it is a fisheye."""

    camera: Intrinsics
    distortion: tuple[float, ...] = ()
    fisheye: bool = False


def lens_of(model: str, camera: Intrinsics, coefficients: Mapping[str, float], source: str) -> Lens:
    """The lens of a named camera model with named coefficients (``k`` means ``k1``); missing coefficients are 0.

    source: the file that states them, for messages. Raises CaptureError for a model that is not in ``MODELS``, or for a
    coefficient that the model lacks.
    """
    if model not in MODELS:
        raise CaptureError(
            f"{source} states the camera model {model}, which is not supported: undistort the images first (colmap "
            f"image_undistorter), or use one of {', '.join(MODELS)}."
        )
    order = _FISHEYE_ORDER if model in FISHEYE_MODELS else _BROWN_ORDER if model in BROWN_MODELS else ()
    stated = {"k1" if name == "k" else name: float(value) for name, value in coefficients.items() if value}
    allowed = order if model != "OPENCV" else _BROWN_ORDER[:5]
    if strange := sorted(set(stated) - set(allowed)):
        raise CaptureError(
            f"{source} states {strange[0]} of the camera model {model}, which is not read: undistort the images first."
        )
    values = tuple(stated.get(name, 0.0) for name in order)
    if model in FISHEYE_MODELS:
        return Lens(camera, values, fisheye=True)
    shortest = next((count for count in _BROWN_COUNTS if not any(values[count:])), 0)
    return Lens(camera, values[:shortest])


class Rectified:
    """Undistorts the images of a lens. The output has the lens's aspect ratio and holds only pixels that the lens sees;
    with barrel distortion, the corners are cut off.

    intrinsics: camera of the output. Raises CaptureError for a distortion that no lens has.
    """

    intrinsics: Intrinsics

    def __init__(self, lens: Lens, max_size: int | None):
        camera = reduce_camera(lens.camera, max_size)
        self.size = camera.width, camera.height
        self.intrinsics = camera
        self._maps: tuple[NDArray[np.float32], NDArray[np.float32]] | None = None
        if lens.fisheye or any(lens.distortion):
            K = _pinhole(camera.matrix, lens, self.size)
            values = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
            check_focal(values, self.size, f"The lens with the distortion {', '.join(map(str, lens.distortion))}")
            distortion = np.array(lens.distortion, np.float64)
            undistort = cv2.fisheye.initUndistortRectifyMap if lens.fisheye else cv2.initUndistortRectifyMap
            self._maps = undistort(camera.matrix, distortion, np.eye(3), K, self.size, cv2.CV_32FC1)
            self.intrinsics = Intrinsics(*self.size, *values)

    def color(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Undistort color (H, W, 3) to (h, w, 3), with area averages where it shrinks."""
        if image.shape[1::-1] != self.size:
            shrinks = image.shape[1] >= self.size[0]
            image = cv2.resize(image, self.size, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)
        return self._moved(image, cv2.INTER_LINEAR, cv2.BORDER_REPLICATE)

    def depth(self, depth_m: NDArray[np.float32]) -> NDArray[np.float32]:
        """Undistort depth (H, W), meters, of any size, to (h, w), meters, by the nearest measured pixel."""
        if depth_m.shape[1::-1] != self.size:
            depth_m = cv2.resize(depth_m, self.size, interpolation=cv2.INTER_NEAREST_EXACT)
        return self._moved(depth_m, cv2.INTER_NEAREST, cv2.BORDER_CONSTANT)

    def _moved(self, image: NDArray[Any], by: int, border: int) -> NDArray[Any]:
        return image if self._maps is None else cv2.remap(image, *self._maps, by, borderMode=border)


def _pinhole(K: NDArray[np.float64], lens: Lens, size: tuple[int, int]) -> NDArray[np.float64]:
    """(3, 3) matrix of the pinhole camera of the same size that sees nothing beyond the lens's image."""
    distortion = np.array(lens.distortion, np.float64)
    try:
        if lens.fisheye:
            found = cv2.fisheye.estimateNewCameraMatrixForUndistortRectify(K, distortion, size, np.eye(3), balance=0.0)
        else:
            found = cv2.getOptimalNewCameraMatrix(K, distortion, size, 0)[0]
    except cv2.error:  # no point of the image's edge has a place
        found = np.full((3, 3), np.nan)
    return np.asarray(found)
