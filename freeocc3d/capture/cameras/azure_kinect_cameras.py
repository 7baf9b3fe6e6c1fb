"""The cameras of an Azure Kinect: its calibration as lenses of the images that a mode gives.

The calibration is for whole sensors: focal lengths and principal points are parts of their widths and heights, and
start at the corner of the first pixel. A mode bins the sensor and takes a part of it. Source: Azure-Kinect-Sensor-SDK,
src/calibration/calibration.c and src/transformation/mode_specific_calibration.c; intrinsic_transformation.c shows that
the model BrownConrady is OpenCV's rational model, and that Rational6KT differs in its tangential terms.
"""

from __future__ import annotations

from typing import Annotated

import msgspec
import numpy as np
from numpy.typing import NDArray

from ...core.errors import CaptureError
from ...core.image_files import Size
from ...core.transforms import invert, is_rigid
from ...core.typed_documents import InvalidDocument, as_type, parse_json
from ...core.types import Intrinsics
from .camera_files import Number, check_focal
from .lenses import Lens
from .rigs import StatedCameras

DEPTH, COLOR = "CALIBRATION_CameraLocationD0", "CALIBRATION_CameraLocationPV0"
_BROWN, _RATIONAL = "CALIBRATION_LensDistortionModelBrownConrady", "CALIBRATION_LensDistortionModelRational6KT"

_DEPTH_MODES = {
    (320, 288): ((512, 512), (96, 90)), (640, 576): ((1024, 1024), (192, 180)),
    (512, 512): ((512, 512), (0, 0)), (1024, 1024): ((1024, 1024), (0, 0)),
}  # fmt: skip
"""Size of depth images -> size of the binned sensor, and corner of the images on it."""

_ORDER = (4, 5, 13, 12, 6, 7, 8, 9)
"""Places of OpenCV's k1 k2 p1 p2 k3 k4 k5 k6 in cx cy fx fy k1 k2 k3 k4 k5 k6 codx cody p2 p1."""
_CENTER_OF_DISTORTION = slice(10, 12)

Numbers = Annotated[tuple[Number, ...], msgspec.Meta(min_length=14)]


class _Intrinsics(msgspec.Struct, rename="pascal"):
    model_parameters: Numbers
    model_type: str


class _Placed(msgspec.Struct, rename="pascal"):
    rotation: Annotated[tuple[Number, ...], msgspec.Meta(min_length=9, max_length=9)]
    translation: Annotated[tuple[Number, ...], msgspec.Meta(min_length=3, max_length=3)]


class _Camera(msgspec.Struct, rename="pascal"):
    location: str
    intrinsics: _Intrinsics
    rt: _Placed
    sensor_width: Annotated[int, msgspec.Meta(gt=0, le=1 << 16)]
    sensor_height: Annotated[int, msgspec.Meta(gt=0, le=1 << 16)]


class _Information(msgspec.Struct, rename="pascal"):
    cameras: list[_Camera]


class _Calibration(msgspec.Struct, rename="pascal"):
    calibration_information: _Information


def read_calibration(data: bytes, color_size: Size, depth_size: Size | None, source: str) -> StatedCameras:
    """The cameras of color and depth images of these sizes. source: the file, for messages. Raises CaptureError."""
    try:
        found = as_type(parse_json(data.rstrip(b"\0"), finite=True), _Calibration)
    except InvalidDocument as error:
        raise CaptureError(f"The calibration in {source} is not usable: {error}.") from error
    cameras = {camera.location: camera for camera in found.calibration_information.cameras}
    if missing := [name for name in (COLOR, DEPTH) if name not in cameras]:
        raise CaptureError(f"The calibration in {source} lacks the camera {missing[0]}.")
    color = _lens(cameras[COLOR], *_color_mode(cameras[COLOR], color_size, source), color_size, source)
    if depth_size is None:
        return StatedCameras(color)
    if depth_size not in _DEPTH_MODES:
        raise CaptureError(
            f"{source} holds depth of {depth_size[0]} x {depth_size[1]} pixels, which no mode of an Azure Kinect has."
        )
    whole, corner = _DEPTH_MODES[depth_size]
    depth = _lens(cameras[DEPTH], _unit(cameras[DEPTH]) * np.tile(whole, 2), np.array(corner), depth_size, source)
    T_color_depth = _place(cameras[COLOR], source) @ invert(_place(cameras[DEPTH], source))
    return StatedCameras(color, depth, T_color_depth)


def _unit(camera: _Camera) -> NDArray[np.float64]:
    """cx, cy, fx, fy as parts of the sensor's width and height."""
    return np.array(camera.intrinsics.model_parameters[:4], np.float64)


def _color_mode(camera: _Camera, size: Size, source: str) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """cx, cy, fx, fy on the binned sensor, which is 4:3, and the corner of images of 4:3 or 16:9 on it."""
    width, height = size
    unit = _unit(camera)
    if camera.sensor_width * 9 == camera.sensor_height * 16:  # the calibration of older devices
        unit = np.array((unit[0], (unit[1] * 2304 + 384) / 3072, unit[2], unit[3] * 2304 / 3072))
    elif camera.sensor_width * 3 != camera.sensor_height * 4:
        raise CaptureError(
            f"The calibration in {source} is for a sensor of {camera.sensor_width} x {camera.sensor_height} pixels, "
            "which no Azure Kinect has."
        )
    if width * 3 != height * 4 and width * 9 != height * 16:
        raise CaptureError(f"{source} holds color of {width} x {height} pixels, which no mode of an Azure Kinect has.")
    whole = width, width * 3 // 4
    return unit * np.tile(whole, 2), np.array((0.0, (whole[1] - height) / 2))


def _lens(
    camera: _Camera, on_sensor: NDArray[np.float64], corner: NDArray[np.float64], size: Size, source: str
) -> Lens:
    """on_sensor: cx, cy, fx, fy on the binned sensor, from the corner of its first pixel."""
    cx, cy, fx, fy = on_sensor.tolist()
    cx, cy = cx - float(corner[0]) - 0.5, cy - float(corner[1]) - 0.5
    check_focal((fx, fy, cx, cy), size, f"The calibration in {source}")
    parameters = camera.intrinsics.model_parameters
    distortion = tuple(parameters[place] for place in _ORDER)
    plain = not any(parameters[_CENTER_OF_DISTORTION])
    tangential = any(distortion[2:4])
    model = camera.intrinsics.model_type
    if not plain or not (model == _BROWN or (model == _RATIONAL and not tangential)):
        raise CaptureError(f"The calibration in {source} states the lens model {model}, which is not supported.")
    return Lens(Intrinsics(*size, fx, fy, cx, cy), distortion)


def _place(camera: _Camera, source: str) -> NDArray[np.float64]:
    """(4, 4) T_camera_rig; the rig is the depth camera."""
    T = np.eye(4)
    T[:3, :3] = np.reshape(camera.rt.rotation, (3, 3))
    T[:3, 3] = camera.rt.translation
    if not is_rigid(T):
        raise CaptureError(f"The calibration in {source} places a camera by what is no rigid transform.")
    return T
