"""Reads folders of the iOS app Stray Scanner: rgb.mp4, depth/, confidence/, camera_matrix.csv and odometry.csv.

Sources: strayrobots/scanner (docs/format.md, and OdometryEncoder.swift, which turns ARKit's cameras to OpenCV's axes);
newer columns of odometry.csv are those that its readers on GitHub describe.
"""

from __future__ import annotations

import contextlib
import functools
import threading
from array import array
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...core.errors import CaptureError, FrameError
from ...core.image_files import Size
from ...core.warnings import Notice
from ..base import Options
from ..cameras.camera_files import Calibration, guess_camera, read_intrinsics, reduce_camera, same_view
from ..cameras.lenses import Lens
from ..cameras.rigs import Rig, StatedCameras, build_rig
from ..files.number_files import POSES_BYTES, read_text
from ..files.numbered_files import has_file, list_folder, list_numbered
from ..frame_files import notice_left_out, read_confidence, read_first_depth_size, read_first_size
from ..images.depth_decoding import METERS, MILLIMETERS, RawDepth, read_raw_depth
from ..images.image_decoding import read_color
from ..poses.frame_poses import ascending_times, poses_of
from ..rgbd_frames import Registration, RgbdFrames
from ..videos.video_process import VideoProcess

REQUIRES: tuple[str, ...] = ("av",)

ODOMETRY, MATRIX = "odometry.csv", "camera_matrix.csv"
VIDEOS = ("rgb.mp4", "rgb.mov", "rgb.mkv")
IMAGE, DEPTH, CONFIDENCE = r"(\d+)\.(?:png|jpe?g)", r"(\d+)\.(?:png|npy)", r"(\d+)\.png"

USUAL_SIZE: Size = (1920, 1440)
"""Size of the app's videos, which its intrinsics are for. Some copies of a folder hold a smaller video."""

_COLUMNS = ("timestamp", "frame", "x", "y", "z", "qx", "qy", "qz", "qw", "fx", "fy", "cx", "cy")
_NEEDED = 9
_OFF_CENTER = 0.25


@dataclass(frozen=True)
class _Odometry:
    """The lines of odometry.csv by frame number: its row in ``table`` (N, 13), of which blank numbers are NaN."""

    rows: Mapping[int, int]
    table: NDArray[np.float64]

    def of(self, number: int) -> NDArray[np.float64]:
        """(13,) numbers of a frame; all NaN if it has no line."""
        row = self.rows.get(number)
        return np.full(len(_COLUMNS), np.nan) if row is None else self.table[row]


class Reader(RgbdFrames):
    """Depth is uint16 millimeters, 256 x 192, or .npy; confidence is 0, 1, 2. Color is frame N of the video, or image N
    of ``rgb/``, which the file names of depth and the column ``frame`` count, too; only numbers that have color and
    depth are frames, with a warning about the others. ``odometry.csv`` has times, poses and, in newer files, a camera
    per frame, which wins over ``camera_matrix.csv``. Both are for the video's size, or ``USUAL_SIZE``.

    Frames stay as they are stored, as depth and poses do, if the video says that a player should turn them. The decoder
    reduces color to the pixels of the depth. Reading in ascending order passes through the video once.
    Raises CaptureError for a missing or damaged file, or no common frame.
    """

    format = "stray_scanner"
    layout = f"{ODOMETRY} and {MATRIX} with rgb.mp4 and depth/"

    def __init__(self, path: Path, options: Options):
        self._lock = threading.Lock()
        self._images = list_numbered(path / "rgb", IMAGE)
        self._video = None if self._images else VideoProcess(_find_video(path), upright=False)
        self._depth = list_numbered(path / "depth", DEPTH) if options.depth else {}
        self._confidence = list_numbered(path / "confidence", CONFIDENCE) if options.depth else {}
        self._numbers, self.warnings = self._choose(path, options)
        self._odometry = _read_odometry(path / ODOMETRY)
        stored_size = self._video.video.size if self._video else read_first_size(self._images.values(), path / "rgb")
        self._stored_size = stored_size
        self._matrix = read_intrinsics(path / MATRIX) if (path / MATRIX).exists() else None
        depth_size = read_first_depth_size(self._depth.values(), path / "depth") if options.depth else None
        self._size = self._read_size(stored_size, depth_size, options)
        self._build = functools.lru_cache(maxsize=16)(
            lambda lens: build_rig(StatedCameras(lens), options, self._size, depth_size)
        )
        self.intrinsics_known = self.focal_stated = self._build(self._lens(self._numbers[0]))[1]
        stated = np.array([self._odometry.of(number) for number in self._numbers])
        self._poses = poses_of(stated[:, 2:5], stated[:, 5:9], opengl=False)
        super().__init__(path, options, self._times(stated[:, 0]), self._units())
        Registration(self.rig(0))  # raises CaptureError for a rig of too large images

    @classmethod
    def recognizes(cls, path: Path) -> bool:
        if not (path / ODOMETRY).is_file():
            return False
        names = list_folder(path)
        with_color = any(name in names for name in VIDEOS) or has_file(path / "rgb", IMAGE)
        return (MATRIX in names or with_color) and has_file(path / "depth", DEPTH)

    def stored_color(self, index: int) -> NDArray[np.uint8]:
        number = self._numbers[index]
        if self._video is None:
            return read_color(self._images[number], self._size)
        with self._lock:
            return self._video.image(number, self._size)

    def stored_depth(self, index: int) -> RawDepth | None:
        camera = self.rig(index).depth.camera
        return read_raw_depth(self._depth[self._numbers[index]], (camera.width, camera.height))

    def stored_confidence(self, index: int) -> NDArray[np.uint8] | None:
        path = self._confidence.get(self._numbers[index])
        return None if path is None else read_confidence(path)

    def rig(self, index: int) -> Rig:
        try:
            return self._build(self._lens(self._numbers[index]))[0]
        except CaptureError as error:
            raise FrameError(f"Frame {self._numbers[index]} of {self.path}: {error}") from error

    def name(self, index: int) -> str:
        """Pose files of other systems refer to the frame by its number."""
        number = self._numbers[index]
        return self._images[number].name if number in self._images else f"{number:06d}.png"

    def pose(self, index: int) -> NDArray[np.float64] | None:
        return self._poses[index]

    def _choose(self, path: Path, options: Options) -> tuple[list[int], tuple[Notice, ...]]:
        """The numbers that have what is needed, and a warning about the others. Raises CaptureError."""
        color = set(range(len(self._video.video.keys)) if self._video else self._images)
        depth = set(self._depth) if options.depth else color
        if options.depth and not depth:
            raise CaptureError(f"{path} holds no depth/N.png: copy it, or map color only with capture.depth=false.")
        kept = sorted(color & depth)
        if not kept:
            raise CaptureError(
                f"No frame of {path} has color and depth: the numbers of depth/ and of the color differ."
            )
        if len(kept) == len(color | depth):
            return kept, ()
        first = min(color ^ depth)
        reason = f"has no {'depth' if first in color else 'color'}"
        return kept, (notice_left_out(len(color ^ depth), len(color | depth), path, str(first), reason),)

    def _read_size(self, stored: Size, depth: Size | None, options: Options) -> Size:
        """The size in which color is read. Images of another view stay as they are, and are refused."""
        if self._video is None:
            return stored
        if depth is not None:
            return depth if depth[0] <= stored[0] and same_view(stored, depth) else stored
        reduced = reduce_camera(guess_camera(stored), options.max_size)
        return reduced.width, reduced.height

    def _lens(self, number: int) -> Lens | None:
        """The camera of a frame. Raises CaptureError."""
        values = tuple(self._odometry.of(number)[9:].tolist())
        if np.isfinite(values).all() and values[0] > 0:
            return _lens_of(values, self._stored_size, f"{ODOMETRY} (frame {number})")
        return _lens_of(self._matrix.values, self._stored_size, self._matrix.source) if self._matrix else None

    def _times(self, stated: NDArray[np.float64]) -> NDArray[np.float64]:
        """(N,) seconds: stated, or those of the video, or the numbers."""
        if np.isfinite(stated).all():
            return ascending_times(stated)
        return self._video.video.times[self._numbers] if self._video else np.array(self._numbers, np.float64)

    def _units(self) -> float:
        """Units per meter of the depth: the app stores integers, others floats."""
        for path in self._depth.values():
            if path.suffix.lower() != ".npy":
                break
            with contextlib.suppress(FrameError):
                return MILLIMETERS if read_raw_depth(path).dtype == np.uint16 else METERS
        return MILLIMETERS


def _find_video(path: Path) -> Path:
    found = next((path / name for name in VIDEOS if (path / name).exists()), None)
    if found is None:
        raise CaptureError(f"{path} has no {VIDEOS[0]}: copy the whole folder of the scan.")
    return found


def _lens_of(values: tuple[float, float, float | None, float | None], color_size: Size, source: str) -> Lens:
    """The camera of color with these values, for the color's size unless their center lies far from its own. Raises
    CaptureError."""
    center = values[2] or 0.0
    size = color_size if abs(2 * center / color_size[0] - 1) <= _OFF_CENTER else USUAL_SIZE
    return Lens(Calibration(values, size, source).camera(size))


def _read_odometry(file: Path) -> _Odometry:
    """Raises CaptureError with the line that is not one of numbers."""
    lines = read_text(file, POSES_BYTES).splitlines()
    header = [word.strip().lower() for word in lines[0].split(",")] if lines else []
    stated = [name in header for name in _COLUMNS]
    if not all(stated[:_NEEDED]):
        raise CaptureError(f"{file} does not start with the names of its columns: {', '.join(_COLUMNS[:_NEEDED])}.")
    at = [header.index(name) if there else None for name, there in zip(_COLUMNS, stated, strict=True)]
    rows, table = dict[int, int](), array("d")
    for count, line in enumerate(lines[1:], 2):
        words = line.split(",")
        try:
            values = [_number(words[place]) if place is not None and place < len(words) else np.nan for place in at]
        except ValueError:
            raise CaptureError(f"{file} holds something else than numbers in line {count}: correct it.") from None
        if 0 <= values[1] < 1e9:
            rows.setdefault(int(values[1]), len(table) // len(_COLUMNS))
            table.extend(values)
    return _Odometry(rows, np.array(table, np.float64).reshape(-1, len(_COLUMNS)))


def _number(word: str) -> float:
    return float(word) if word.strip() else np.nan
