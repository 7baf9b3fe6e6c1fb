"""Reads COLMAP models (cameras, images, points3D, as .bin or .txt) and their lenses.

Read here and not by pycolmap, whose reader takes the counts in a damaged file at their word: it loops without end, or
takes all memory. ``rigs`` and ``frames`` of newer models are not needed, because ``images`` states each image's pose.

Source: COLMAP's "Output Format" and src/colmap/scene/reconstruction_io_{binary,text}.cc.
"""

from __future__ import annotations

import struct
from array import array
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from ...core.errors import CaptureError
from ...core.regular_files import read_bytes, read_text
from ...core.transforms import quats_to_rotations
from ...core.types import Intrinsics
from ..cameras.camera_files import FARTHEST, check_focal
from ..cameras.lenses import Lens, lens_of

T = TypeVar("T")

_F, _FF = "f cx cy", "fx fy cx cy"
PARAMETERS = {
    "SIMPLE_PINHOLE": _F, "PINHOLE": _FF, "SIMPLE_RADIAL": f"{_F} k", "RADIAL": f"{_F} k1 k2",
    "OPENCV": f"{_FF} k1 k2 p1 p2", "OPENCV_FISHEYE": f"{_FF} k1 k2 k3 k4",
    "FULL_OPENCV": f"{_FF} k1 k2 p1 p2 k3 k4 k5 k6", "FOV": f"{_FF} omega", "SIMPLE_RADIAL_FISHEYE": f"{_F} k",
    "RADIAL_FISHEYE": f"{_F} k1 k2", "THIN_PRISM_FISHEYE": f"{_FF} k1 k2 p1 p2 k3 k4 sx1 sy1",
    "RAD_TAN_THIN_PRISM_FISHEYE": f"{_FF} k0 k1 k2 k3 k4 k5 p0 p1 s0 s1 s2 s3", "SIMPLE_DIVISION": f"{_F} k",
    "DIVISION": f"{_FF} k", "SIMPLE_FISHEYE": _F, "FISHEYE": _FF, "EUCM": f"{_FF} alpha beta", "EQUIRECTANGULAR": "w h",
}  # fmt: skip
"""Camera models with the names of their parameters, in the order of their numbers in .bin files."""

_MODEL_BYTES = 1 << 30
_LONGEST_NAME = 4096
_MOST_OBSERVED = 1_000_000
_WIDEST = 1_000_000
_NO_POINT = np.uint64(2**64 - 1)


@dataclass(frozen=True)
class ModelCamera:
    """A camera as the model states it: ``params`` has the values that ``PARAMETERS[model]`` names."""

    model: str
    width: int
    height: int
    params: tuple[float, ...]

    def lens(self, source: str) -> Lens:
        """The lens. COLMAP's pixel coordinates start at the corner of the first pixel, ours at its center. source:
        where the model comes from, for messages. Raises CaptureError for an unsupported or impossible camera."""
        values = dict(zip(PARAMETERS.get(self.model, "").split(), self.params, strict=True))
        fx = values.pop("fx", values.pop("f", 1.0))
        fy = values.pop("fy", fx)
        cx, cy = values.pop("cx", 0.5) - 0.5, values.pop("cy", 0.5) - 0.5
        lens = lens_of(self.model, Intrinsics(self.width, self.height, fx, fy, cx, cy), values, source)
        check_focal((fx, fy, cx, cy), (self.width, self.height), source)
        return lens


@dataclass(frozen=True)
class ModelImage:
    """A registered image. T_cam_world: (4, 4).  seen: (K,) uint64, the points that the image sees."""

    name: str
    camera: int
    T_cam_world: NDArray[np.float64]
    seen: NDArray[np.uint64]


@dataclass(frozen=True)
class ColmapModel:
    """cameras: by number.  points: (P, 3), in the model's unit.  point_ids: (P,) uint64, their numbers, ascending."""

    cameras: dict[int, ModelCamera]
    images: list[ModelImage]
    points: NDArray[np.float64]
    point_ids: NDArray[np.uint64]

    def rows(self, ids: NDArray[np.uint64]) -> NDArray[np.int64]:
        """Rows of the points with these numbers. Raises KeyError for a number without a point."""
        rows = np.searchsorted(self.point_ids, ids)
        if len(ids) and (rows.max() >= len(self.point_ids) or (self.point_ids[rows] != ids).any()):
            raise KeyError("a point")
        return rows


def read_colmap_model(folder: Path) -> ColmapModel:
    """Read the model in a folder. Raises CaptureError with the name of the file that is missing or damaged."""
    if (folder / "images.bin").is_file():
        return _checked(
            folder,
            _part(folder / "cameras.bin", _binary_cameras),
            _part(folder / "images.bin", _binary_images),
            _part(folder / "points3D.bin", _binary_points),
        )
    return _checked(
        folder,
        _part(folder / "cameras.txt", _text_cameras),
        _part(folder / "images.txt", _text_images),
        _part(folder / "points3D.txt", _text_points),
    )


def _part(path: Path, read: Callable[[Path], T]) -> T:
    try:
        return read(path)
    except (OSError, ValueError, OverflowError, struct.error) as error:
        said = (
            error.strerror
            if isinstance(error, OSError)
            else "it is cut off"
            if isinstance(error, struct.error)
            else error
        )
        raise CaptureError(
            f"{path.parent} holds no readable COLMAP model: it needs complete cameras, images and points3D, all .txt "
            f"or all .bin, but {path.name} cannot be read: {said}."
        ) from error


def _checked(
    folder: Path, cameras: dict[int, ModelCamera], images: list[ModelImage], points: tuple[Any, Any]
) -> ColmapModel:
    """The model, with its points in order. Raises CaptureError if a part names one that another part lacks."""
    ids, order = np.unique(points[0], return_index=True)
    if len(ids) < len(points[0]):
        raise CaptureError(f"The COLMAP model in {folder} is damaged: a point is listed twice.")
    model = ColmapModel(cameras, images, points[1][order], ids)
    for image in images:
        if image.camera not in cameras:
            raise CaptureError(
                f"The COLMAP model in {folder} is damaged: {image.name} has camera {image.camera}, which is missing."
            )
        try:
            model.rows(image.seen)
        except KeyError as error:
            raise CaptureError(
                f"The COLMAP model in {folder} is damaged: {image.name} sees points that points3D lacks."
            ) from error
    return model


def _camera(model: str, width: int, height: int, params: tuple[float, ...]) -> ModelCamera:
    if not (0 < width <= _WIDEST and 0 < height <= _WIDEST) or not np.isfinite(params).all():
        raise ValueError("a camera has no possible size or parameters")
    return ModelCamera(model, width, height, params)


def _pose(numbers: tuple[float, ...]) -> NDArray[np.float64]:
    """(4, 4) T_cam_world from a quaternion wxyz, of any length, and a position."""
    quat_wxyz, t = np.array(numbers[:4]), np.array(numbers[4:])
    length = np.linalg.norm(quat_wxyz)
    if not 1e-6 < length < 1e6 or not (np.abs(t) <= FARTHEST).all():
        raise ValueError("an image has no possible pose")
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = quats_to_rotations(quat_wxyz / length), t
    return T


def _points(ids: array[int], positions: array[float]) -> tuple[NDArray[np.uint64], NDArray[np.float64]]:
    xyz = np.array(positions, np.float64).reshape(-1, 3)
    if not (np.abs(xyz) <= FARTHEST).all():
        raise ValueError("a point has no possible position")
    return np.array(ids, np.uint64), xyz


def _unique(numbers: list[int], what: str) -> list[int]:
    if len(set(numbers)) < len(numbers):
        raise ValueError(f"two {what} have the same number")
    return numbers


class _Records:
    """The bytes of a .bin file, read from the start. The first 8 bytes are the number of records."""

    def __init__(self, path: Path):
        self._data, self._at = read_bytes(path, _MODEL_BYTES), 0
        self._count = self.take("Q")[0]

    def __iter__(self) -> Iterator[None]:
        """One step per record. Raises ValueError if the file does not end after the last."""
        for _ in range(self._count):
            if self._at >= len(self._data):
                raise ValueError(f"it ends before the last of {self._count} records")
            yield
        if self._at != len(self._data):
            raise ValueError(f"it holds more than the {self._count} records that it states")

    def take(self, form: str) -> tuple[Any, ...]:
        """The next values. Raises struct.error at the end."""
        values = struct.unpack_from(f"<{form}", self._data, self._at)
        self._at += struct.calcsize(f"<{form}")
        return values

    def name(self) -> str:
        """A text that ends with NUL. Raises ValueError."""
        end = self._data.find(b"\0", self._at, self._at + _LONGEST_NAME)
        if end < 0:
            raise ValueError("the name of an image does not end")
        name, self._at = self._data[self._at : end].decode("utf-8"), end + 1
        return name

    def skip(self, count: int, size: int) -> bytes:
        """The next ``count`` items of ``size`` bytes. Raises ValueError if the file is shorter."""
        start, self._at = self._at, self._at + count * size
        if self._at > len(self._data):
            raise ValueError(f"it ends before the last of {self._count} records")
        return self._data[start : self._at]


def _binary_cameras(path: Path) -> dict[int, ModelCamera]:
    records, numbers, cameras = _Records(path), list[int](), []
    for _ in records:
        number, model, width, height = records.take("IiQQ")
        if not 0 <= model < len(PARAMETERS):
            raise ValueError(f"there is no camera model with number {model}")
        name, parameters = list(PARAMETERS.items())[model]
        numbers.append(number)
        cameras.append(_camera(name, width, height, records.take(f"{len(parameters.split())}d")))
    return dict(zip(_unique(numbers, "cameras"), cameras, strict=True))


def _binary_images(path: Path) -> list[ModelImage]:
    records, numbers, images = _Records(path), list[int](), []
    observation = np.dtype([("pixel", "<f8", 2), ("point", "<u8")])
    for _ in records:
        number, *numbers_of_pose, camera = records.take("I7dI")
        name = records.name()
        seen = np.frombuffer(records.skip(records.take("Q")[0], observation.itemsize), observation)["point"]
        numbers.append(number)
        images.append(ModelImage(name, camera, _pose(tuple(numbers_of_pose)), seen[seen != _NO_POINT]))
    _unique(numbers, "images")
    return images


def _binary_points(path: Path) -> tuple[NDArray[np.uint64], NDArray[np.float64]]:
    records, ids, positions = _Records(path), array("Q"), array("d")
    for _ in records:
        number, x, y, z, track = records.take("Q3d3x8xQ")
        records.skip(track, 8)
        ids.append(number)
        positions.extend((x, y, z))
    return _points(ids, positions)


def _lines(path: Path) -> Iterator[str]:
    return iter(read_text(path).splitlines())


def _rows(path: Path, most: int) -> Iterator[list[str]]:
    """The words of each line, at most ``most`` and the rest of the line; without comments and empty lines."""
    for line in _lines(path):
        words = line.split(maxsplit=most)
        if words and not words[0].startswith("#"):
            yield words


def _text_cameras(path: Path) -> dict[int, ModelCamera]:
    numbers, cameras = list[int](), []
    for number, model, width, height, *params in _rows(path, 20):
        if model not in PARAMETERS or len(params) != len(PARAMETERS[model].split()):
            raise ValueError(f"there is no camera model {model[:40]} of {len(params)} parameters")
        numbers.append(int(number))
        cameras.append(_camera(model, int(width), int(height), tuple(map(float, params))))
    return dict(zip(_unique(numbers, "cameras"), cameras, strict=True))


def _text_images(path: Path) -> list[ModelImage]:
    numbers, images, lines = list[int](), [], _lines(path)
    for line in lines:
        words = line.split(maxsplit=9)
        if not words or words[0].startswith("#"):
            continue
        number, *pose, camera, name = words
        observed = next(lines, "").split(maxsplit=3 * _MOST_OBSERVED)
        if len(pose) != 7 or len(name) > _LONGEST_NAME or len(observed) % 3:
            raise ValueError(f"line {len(numbers) * 2 + 1} or the next is not that of an image")
        seen = np.array([int(point) for point in observed[2::3] if point != "-1"], np.uint64)
        numbers.append(int(number))
        images.append(ModelImage(name.strip(), int(camera), _pose(tuple(map(float, pose))), seen))
    _unique(numbers, "images")
    return images


def _text_points(path: Path) -> tuple[NDArray[np.uint64], NDArray[np.float64]]:
    ids, positions = array("Q"), array("d")
    for number, *position in _rows(path, 4):
        ids.append(int(number))
        positions.extend([float(value) for value in position[:3]])
        if len(position) < 3:
            raise ValueError("a point has no possible position")
    return _points(ids, positions)
