"""Keyframes on disk: color (JPEG), depth (16-bit PNG, millimeters), the depth's standard deviation where it has one of
its own (16-bit PNG, half millimeters), and intrinsics. Later layers need no more of the capture. Keyframes are written
during tracking, and read one at a time."""

from __future__ import annotations

import contextlib
import json
import shutil
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Annotated, overload

import cv2
import msgspec
import numpy as np
from numpy.typing import NDArray

from ..core.atomic_files import replace_text, sync
from ..core.checksums import hash_bytes, hash_file
from ..core.depth_sensors import STRUCTURED_LIGHT, DepthSensor
from ..core.errors import MapError
from ..core.image_files import ImageFileError, WrongSizeError, read_image
from ..core.regular_files import read_bytes
from ..core.typed_documents import InvalidDocument, as_type, parse_json
from ..core.types import Frame, Intrinsics

INDEX = "keyframes.json"
_UNITS_PER_METER, _SIGMA_UNITS_PER_METER = 1000.0, 2000.0
_SIGMA = "sigma"
"""Key of the entries that have a third image."""
_JPEG_QUALITY = 95
_MOST_BYTES, _FARTHEST = 64 << 20, 1e15
_Number = Annotated[float, msgspec.Meta(ge=0, le=(1 << 31) - 1)]
_Side = Annotated[float, msgspec.Meta(ge=1, le=1 << 16)]
_Focal = Annotated[float, msgspec.Meta(ge=1e-3, le=1e9)]
_Center = Annotated[float, msgspec.Meta(ge=-1e9, le=1e9)]


class Keyframes(Sequence[Frame]):
    """The keyframes in a folder, in order; ``self[row]`` decodes one. Raises MapError for a missing or broken file.

    sensor: that of the decoded frames.
    """

    def __init__(self, folder: Path, sensor: DepthSensor = STRUCTURED_LIGHT):
        self.folder = folder
        self.sensor = sensor
        self._entries: list[dict[str, float]] = []
        self._checksums: dict[str, str] = {}  # of the images that this object wrote
        self._unsynced: list[Path] = []
        self._check: Callable[[Path], object] = lambda path: None

    @classmethod
    def load(cls, folder: Path, check: Callable[[Path], object] = lambda path: None) -> Keyframes:
        """Read the index of a folder. check: raises MapError for a damaged image, before it is decoded. Raises
        MapError."""
        keyframes = cls(folder)
        path = folder / INDEX
        try:
            entries = as_type(parse_json(read_bytes(path, _MOST_BYTES)), list[_Entry])
        except OSError as error:
            raise MapError(f"Cannot read the keyframe index {path}: {error.strerror}.") from error
        except InvalidDocument as error:
            raise MapError(f"{path} is damaged: {error}.") from error
        if problem := _problem(entries):
            raise MapError(f"{path} is damaged: {problem}.")
        keyframes._entries = [
            {name: value for name in entry.__struct_fields__ if (value := getattr(entry, name)) is not None}
            for entry in entries
        ]
        keyframes._check = check
        return keyframes

    def append(self, frame: Frame) -> None:
        """Write a keyframe. Raises OSError."""
        self.folder.mkdir(parents=True, exist_ok=True)
        self._write_images(frame)
        camera = frame.intrinsics
        self._entries.append(
            {"frame": frame.index, "timestamp": frame.timestamp, "width": camera.width, "height": camera.height,
             "fx": camera.fx, "fy": camera.fy, "cx": camera.cx, "cy": camera.cy,
             **({} if frame.depth_sigma_m is None else {_SIGMA: 1.0})}
        )  # fmt: skip

    def copy_to(self, folder: Path, depth_factor: float = 1.0) -> None:
        """Write the keyframes to another folder, with depth times a factor. Raises OSError, MapError."""
        folder.mkdir(parents=True, exist_ok=True)
        copied = Keyframes(folder)
        for entry in self._entries:
            color_path, *depth_paths = self._own_paths(entry)
            self._check(color_path)
            shutil.copyfile(color_path, folder / color_path.name)
            if depth_factor == 1:
                for path in depth_paths:
                    self._check(path)
                    shutil.copyfile(path, folder / path.name)
            else:
                copied._write_depth(self._read(entry).scaled(depth_factor))
            copied._entries.append(entry)
        copied.save_index()

    def only(self, frames: NDArray[np.integer]) -> Keyframes:
        """The keyframes among the given frames of the capture, in the same folder."""
        chosen = Keyframes(self.folder, self.sensor)
        chosen._check = self._check
        wanted = set(frames.tolist())
        chosen._entries = [entry for entry in self._entries if int(entry["frame"]) in wanted]
        return chosen

    def sync(self) -> None:
        """Wait until all images are on the disk. Raises OSError."""
        for path in self._unsynced:
            sync(path)
        self._unsynced.clear()

    def checkpoint(self) -> str:
        """What ``resumed`` needs, when all images are on the disk. Raises OSError."""
        self.sync()
        return json.dumps({"entries": self._entries, "checksums": self._checksums})

    @classmethod
    def resumed(
        cls, folder: Path, checkpoint: str, read: Callable[[int], Frame], sensor: DepthSensor = STRUCTURED_LIGHT
    ) -> Keyframes:
        """The keyframes of a ``checkpoint``. Images that are missing or damaged are written again.

        read: gives a frame of the capture as ``append`` got it. Raises OSError, and what ``read`` raises.
        """
        kept, stated = cls(folder, sensor), json.loads(checkpoint)
        kept._entries, kept._checksums = stated["entries"], stated["checksums"]
        folder.mkdir(parents=True, exist_ok=True)
        for entry in kept._entries:
            index = int(entry["frame"])
            if not all(kept._whole(path) for path in kept._own_paths(entry)):
                kept._write_images(read(index))
        return kept

    def _whole(self, path: Path) -> bool:
        try:
            return hash_file(path) == self._checksums.get(path.name)
        except OSError:
            return False

    def save_index(self) -> None:
        """Write the index atomically. Raises OSError."""
        self.folder.mkdir(parents=True, exist_ok=True)
        replace_text(self.folder / INDEX, json.dumps(self._entries, indent=0))

    def __len__(self) -> int:
        return len(self._entries)

    @overload
    def __getitem__(self, row: int) -> Frame: ...
    @overload
    def __getitem__(self, row: slice) -> list[Frame]: ...
    def __getitem__(self, row: int | slice) -> Frame | list[Frame]:
        if isinstance(row, slice):
            return [self._read(entry) for entry in self._entries[row]]
        return self._read(self._entries[row])

    def __iter__(self) -> Iterator[Frame]:
        return map(self._read, list(self._entries))

    @property
    def frames(self) -> list[int]:
        """The capture's frame of each keyframe."""
        return [int(entry["frame"]) for entry in self._entries]

    def views(self) -> list[tuple[Path, Intrinsics]]:
        """The color image's path and the camera of each keyframe. Decodes nothing."""
        return [(self._paths(int(entry["frame"]))[0], _camera(entry)) for entry in self._entries]

    def paths(self) -> list[Path]:
        """The images of all keyframes."""
        return [path for entry in self._entries for path in self._own_paths(entry)]

    def depth_m(self, row: int) -> NDArray[np.float32]:
        """(H, W) depth of a keyframe, meters; 0 = no measurement. Does not decode its color image."""
        return self._read_units(self._entries[row], 1) / np.float32(_UNITS_PER_METER)

    def depth_images(self) -> Iterator[tuple[NDArray[np.float32], NDArray[np.float32] | DepthSensor, Intrinsics]]:
        """Yields of each keyframe ``depth_m``; the standard deviations, (H, W) meters or those of its sensor; and the
        camera."""
        for row, entry in enumerate(self._entries):
            sigma_m = self._read_sigma(entry)
            yield self.depth_m(row), self.sensor if sigma_m is None else sigma_m, _camera(entry)

    def _read_sigma(self, entry: dict[str, float]) -> NDArray[np.float32] | None:
        return self._read_units(entry, 2) / np.float32(_SIGMA_UNITS_PER_METER) if _SIGMA in entry else None

    def _read(self, entry: dict[str, float]) -> Frame:
        index = int(entry["frame"])
        color = self._decoded(entry, 0, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
        depth_m = self._read_units(entry, 1) / np.float32(_UNITS_PER_METER)
        rgb = cv2.cvtColor(color, cv2.COLOR_BGR2RGB)
        return Frame(index, entry["timestamp"], rgb, depth_m, _camera(entry), self._read_sigma(entry), self.sensor)

    def _read_units(self, entry: dict[str, float], image: int) -> NDArray[np.float32]:
        units = self._decoded(entry, image, cv2.IMREAD_UNCHANGED)
        if units.dtype != np.uint16 or units.ndim != 2:
            raise MapError(f"{self._own_paths(entry)[image]} is damaged: it is not a gray image of 16 bits.")
        return units.astype(np.float32)

    def _decoded(self, entry: dict[str, float], image: int, flags: int) -> NDArray[np.generic]:
        """One of a keyframe's images, which has the size of its camera."""
        path, camera = self._own_paths(entry)[image], _camera(entry)
        self._check(path)
        try:
            return read_image(path, flags, (camera.width, camera.height))
        except WrongSizeError as error:
            raise MapError(f"{path} does not have the size that {INDEX} states: {error}") from error
        except ImageFileError as error:
            raise MapError(str(error)) from error

    def _write_images(self, frame: Frame) -> None:
        bgr = cv2.cvtColor(frame.color, cv2.COLOR_RGB2BGR)
        color = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])[1]
        self._write(self._paths(frame.index)[0], color.tobytes())
        self._write_depth(frame)

    def _write_depth(self, frame: Frame) -> None:
        _, depth_path, sigma_path = self._paths(frame.index)
        self._write(depth_path, _encoded(frame.depth_m * _UNITS_PER_METER))
        if frame.depth_sigma_m is not None:
            sigma = np.maximum(frame.depth_sigma_m * np.float32(_SIGMA_UNITS_PER_METER), 1)  # 0 would weigh infinitely
            self._write(sigma_path, _encoded(np.where(frame.depth_m > 0, sigma, 0)))

    def _write(self, path: Path, data: bytes) -> None:
        with contextlib.suppress(FileNotFoundError):
            path.unlink()  # never through a link
        path.write_bytes(data)
        self._checksums[path.name] = hash_bytes(data)
        self._unsynced.append(path)

    def _own_paths(self, entry: dict[str, float]) -> tuple[Path, ...]:
        return self._paths(int(entry["frame"]))[: 2 + (_SIGMA in entry)]

    def _paths(self, index: int) -> tuple[Path, Path, Path]:
        """The paths of a frame's color, depth and standard-deviation images."""
        name = self.folder / f"{index:06d}"
        return name.with_suffix(".color.jpg"), name.with_suffix(".depth.png"), name.with_suffix(".depth_sigma.png")


def _encoded(values: NDArray[np.float32]) -> bytes:
    units = np.clip(np.rint(values), 0, 65535).astype(np.uint16)
    return bytes(cv2.imencode(".png", units, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1].tobytes())


def _camera(entry: dict[str, float]) -> Intrinsics:
    return Intrinsics(int(entry["width"]), int(entry["height"]), entry["fx"], entry["fy"], entry["cx"], entry["cy"])


class _Entry(msgspec.Struct, frozen=True):
    """A keyframe in the index; all numbers are read as floats."""

    frame: _Number
    timestamp: Annotated[float, msgspec.Meta(ge=-_FARTHEST, le=_FARTHEST)]
    width: _Side
    height: _Side
    fx: _Focal
    fy: _Focal
    cx: _Center
    cy: _Center
    sigma: float | None = None


def _problem(entries: list[_Entry]) -> str:
    """The problem of an index whose types are right; empty if it has none."""
    numbers = np.array([(entry.frame, entry.width, entry.height) for entry in entries], np.float64).reshape(-1, 3)
    if (numbers % 1).any():
        return "a frame, a width or a height is not a whole number"
    return "" if (np.diff(numbers[:, 0]) > 0).all() else "its frames are not in ascending order"
