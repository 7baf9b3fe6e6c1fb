"""Reads camera parameters and poses from text files, and refuses impossible values with a clear message."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, TypeVar

import msgspec
import numpy as np
from numpy.typing import NDArray

from ...core.errors import CaptureError
from ...core.image_files import Size
from ...core.transforms import is_rigid
from ...core.typed_documents import InvalidDocument, as_type, parse_json
from ...core.types import Intrinsics
from ..base import Options
from ..files.number_files import JSON_BYTES, MATRIX_BYTES, read_number_rows, read_text

ASPECT_TOLERANCE = 0.02
"""Largest relative difference of the aspect ratios of two images that show the same view. ScanNet's color and depth
differ by 0.4 %, a 16:9 and a 4:3 image by 33 %."""

MAX_SKEW_PX = 1.0
"""Largest skew that is ignored. Calibrations state tiny skews; the camera model here has none."""


USUAL_FOCAL = 0.85
"""Default focal length over the longer side of an image. A phone's main camera (24 to 28 mm equivalent) has 0.72 to
0.78 in photographs and 0.8 to 0.95 in videos, which stabilization crops. The color cameras of depth sensors have 0.82
to 0.96. The default is within a fifth of all of them, close enough for an estimate to start from."""


FOCAL_RANGE = 0.01, 1000.0
"""Focal lengths of cameras over the longer side of their images: from a view of 179 degrees to one of 0.06."""


DIAGONAL_35MM = 43.27
"""Diagonal of the 36 x 24 mm frame, millimeters."""


FARTHEST = 1e9
"""Largest coordinate of a point or camera, in any unit; larger ones are damage."""

T = TypeVar("T")

Number = Annotated[float, msgspec.Meta(ge=-1e9, le=1e9)]
"""A number of a document: finite, and no larger than a length or a coefficient can be."""

PositiveNumber = Annotated[float, msgspec.Meta(gt=0, le=1e9)]


class _Open3DCamera(msgspec.Struct):
    """PinholeCameraIntrinsic as Open3D writes it: ``intrinsic_matrix`` is column-major."""

    width: PositiveNumber
    height: PositiveNumber
    intrinsic_matrix: Annotated[tuple[Number, ...], msgspec.Meta(min_length=9, max_length=9)]


@dataclass(frozen=True)
class Calibration:
    """Stated intrinsics. values: fx, fy, cx, cy, pixels; without cx and cy, the center of the
    image.  size: the image size that they refer to; None = the size of
    the images found.  source: where they come from, for messages."""

    values: tuple[float, float, float | None, float | None]
    size: Size | None
    source: str

    def camera(self, size: Size) -> Intrinsics:
        """The camera of images of ``size``. Parameters for another size of the same view are rescaled.

        Raises CaptureError: a value is not finite, a focal length that no camera has, the principal point outside the
        image, or the size shows another view.
        """
        width, height = self.size or size
        fx, fy, cx, cy = self.values
        cx, cy = (width - 1) / 2 if cx is None else cx, (height - 1) / 2 if cy is None else cy
        check_focal((fx, fy, cx, cy), (width, height), self.source)
        if min(width, height) <= 0 or not same_view((width, height), size):
            raise CaptureError(
                f"{self.source} is for images of {width} x {height} pixels, but the images have {size[0]} x {size[1]}: "
                "correct it, or give capture.intrinsics."
            )
        if not (0 <= cx <= width and 0 <= cy <= height):
            raise CaptureError(
                f"{self.source} puts the principal point at ({cx:g}, {cy:g}), outside the {width} x {height} image, "
                "so it may be for another resolution: correct it, or give capture.intrinsics."
            )
        return Intrinsics(width, height, fx, fy, cx, cy).resized(*size)


def check_focal(values: tuple[float, float, float, float], size: Size, source: str) -> None:
    """Raise CaptureError if fx, fy, cx, cy are not those of a camera with images of ``size``. source: for messages."""
    fx, fy, cx, cy = values
    low, high = (ratio * max(size) for ratio in FOCAL_RANGE)
    if not np.isfinite(values).all() or not low <= min(fx, fy) <= max(fx, fy) <= high:
        raise CaptureError(
            f"{source} holds unusable intrinsics (fx, fy, cx, cy = {fx:g}, {fy:g}, {cx:g}, {cy:g}): "
            "correct it, or give capture.intrinsics."
        )


def same_view(a: Size, b: Size) -> bool:
    """Whether images of these sizes can show the same view, that is, have the same aspect ratio."""
    return abs(a[0] * b[1] / (a[1] * b[0]) - 1.0) < ASPECT_TOLERANCE


def rescale_camera(camera: Intrinsics, size: Size) -> Intrinsics:
    """The camera of images of ``size`` that show the same view. Raises CaptureError for another aspect ratio."""
    if not same_view((camera.width, camera.height), size):
        raise CaptureError(
            f"One camera cannot have taken images of {camera.width} x {camera.height} and of {size[0]} x {size[1]} "
            "pixels, for their shapes differ: record depth aligned to color, or add a calibration of each camera, in "
            "intrinsic/intrinsic_color.txt and intrinsic/intrinsic_depth.txt, and where the two lie relative to each "
            "other, in intrinsic/extrinsic_depth.txt; or map color alone with capture.depth=false."
        )
    return camera.resized(*size)


def guess_camera(size: Size) -> Intrinsics:
    """The default camera for images of ``size`` without any calibration."""
    width, height = size
    focal = USUAL_FOCAL * max(size)
    return Intrinsics(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)


def convert_35mm(focal_35mm: float, size: Size) -> Intrinsics | None:
    """The camera of images of ``size`` from a 35 mm equivalent focal length, millimeters, which refers to the image
    diagonal. None if the value is out of range."""
    if not 8 <= focal_35mm <= 500:
        return None
    width, height = size
    focal = focal_35mm / DIAGONAL_35MM * float(np.hypot(width, height))
    return Intrinsics(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)


def reduce_camera(camera: Intrinsics, max_size: int | None) -> Intrinsics:
    """The camera of the same images, reduced to at most ``max_size`` pixels on the longer side."""
    longer = max(camera.width, camera.height)
    if max_size is None or longer <= max_size:
        return camera
    width, height = (max(1, round(side * max_size / longer)) for side in (camera.width, camera.height))
    return camera.resized(width, height)


def read_given_calibration(options: Options) -> Calibration | None:
    """The color camera that ``capture.intrinsics`` or ``capture.focal`` states, or None."""
    if options.intrinsics:
        return Calibration(options.intrinsics, None, "capture.intrinsics")
    return Calibration((options.focal, options.focal, None, None), None, "capture.focal") if options.focal else None


def read_intrinsics(path: Path) -> Calibration:
    """Read a text file with K (3 x 3, or 4 x 4 with K in its corner), or an Open3D camera file (``.json``).

    Raises CaptureError with the file's name.
    """
    if path.suffix == ".json":
        return _open3d_intrinsics(path)
    matrix = read_matrix(path)
    if matrix is None or matrix.shape not in ((3, 3), (4, 4)):
        raise CaptureError(f"{path} must hold a camera matrix of 3 x 3 or 4 x 4 numbers.")
    return _from_matrix(matrix[:3, :3], None, path)


def read_rigid(path: Path) -> NDArray[np.float64]:
    """Read a (4, 4) rigid transform. Raises CaptureError with the file's name."""
    matrix = read_matrix(path)
    if matrix is None or not is_pose(matrix):
        raise CaptureError(f"{path} must hold a rigid transform of 4 x 4 numbers: correct or remove it.")
    return matrix


def read_pose(path: Path) -> NDArray[np.float64] | None:
    """Read (4, 4) T_world_cam; None if the file is missing or holds no rigid transform. ScanNet writes -inf where
    tracking was lost."""
    matrix = read_matrix(path) if os.path.lexists(path) else None
    return matrix if matrix is not None and is_pose(matrix) else None


def explain_no_pose(T: NDArray[np.float64] | None) -> str:
    """Why a matrix of a file, or None for a file without one, is no camera-to-world pose; part of a sentence."""
    if T is None or T.shape != (4, 4):
        return "is not a matrix of 4 x 4 numbers"
    if not np.isfinite(T).all():
        return "holds numbers that are not finite"
    if not T[:3, :3].any():
        return "is all zeros"
    if not is_rigid(np.block([[T[:3, :3], np.zeros((3, 1))], [np.eye(4)[3:]]])):
        return _explain_axes(T[:3, :3])
    if np.abs(T[3] - (0, 0, 0, 1)).max() > 1e-3:
        transposed = "it is transposed, with the position in its last row" if T[3, 3] == 1 else "not 0 0 0 1"
        return f"has the last row {' '.join(f'{value:g}' for value in T[3])} ({transposed})"
    return f"has a position farther than {FARTHEST:g}"


def _explain_axes(R: NDArray[np.float64]) -> str:
    scale = float(np.cbrt(abs(np.linalg.det(R))))
    if scale == 0 or np.abs(R @ R.T / scale**2 - np.eye(3)).max() > 1e-2:
        return "has axes that are not at right angles or not of one length"
    if np.linalg.det(R) < 0:
        return f"has determinant {np.linalg.det(R):.3g} (mirrored axes, those of a left-handed world)"
    return f"has axes of length {scale:.4g}, not 1 (is it scaled?)"


def check_pose_files(files: Sequence[Path], where: str) -> None:
    """Raise CaptureError if there are files but none holds a pose; stops at the first that does. where: names the files
    in the message."""
    faults = dict[bool, str]()
    for file in files:
        matrix = read_matrix(file)
        if matrix is not None and is_pose(matrix):
            return
        stated = matrix is not None and bool(np.isfinite(matrix).all())  # not of a frame that was lost
        faults.setdefault(stated, f"{file.name} {explain_no_pose(matrix)}")
    if faults:
        be = "file, which is not" if len(files) == 1 else "files, of which none is"
        raise CaptureError(
            f"{where} holds {len(files)} pose {be} a rigid right-handed camera-to-world matrix: "
            f"{faults.get(True) or faults[False]}. Correct or remove them."
        )


def is_pose(T: NDArray[np.float64]) -> bool:
    """Whether a (4, 4) matrix is a rigid transform whose position is possible."""
    return is_rigid(T) and bool(np.abs(T[:3, 3]).max() <= FARTHEST)


def read_matrix(path: Path) -> NDArray[np.float64] | None:
    """Read a text file of (rows, columns) numbers; None if it holds anything else. Raises CaptureError if the file
    cannot be read."""
    try:
        return read_number_rows(path, MATRIX_BYTES).table()
    except ValueError:  # words
        return None


def read_json(path: Path, kind: type[T]) -> T:
    """Read a JSON document as the type ``kind``. Raises CaptureError with the names of the file and the field."""
    text = read_text(path, JSON_BYTES)
    try:
        return as_type(parse_json(text, finite=True), kind)
    except InvalidDocument as error:
        raise CaptureError(f"{path} is not usable: {error}. Correct it.") from error


def _open3d_intrinsics(path: Path) -> Calibration:
    content = read_json(path, _Open3DCamera)
    matrix = np.array(content.intrinsic_matrix).reshape(3, 3).T
    return _from_matrix(matrix, (int(content.width), int(content.height)), path)


def _from_matrix(K: NDArray[np.float64], size: Size | None, path: Path) -> Calibration:
    if not np.isfinite(K).all():
        raise CaptureError(f"{path} holds NaN or infinite numbers: correct it, or give capture.intrinsics.")
    if np.abs(K[2] - (0, 0, 1)).max() > 1e-6 or abs(K[1, 0]) > MAX_SKEW_PX or abs(K[0, 1]) > MAX_SKEW_PX:
        raise CaptureError(f"{path} is not a camera matrix: it must read fx 0 cx / 0 fy cy / 0 0 1.")
    fx, fy, cx, cy = K[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()
    return Calibration((fx, fy, cx, cy), size, str(path))
