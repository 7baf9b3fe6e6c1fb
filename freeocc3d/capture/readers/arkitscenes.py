"""Reads scans of ARKitScenes: color, depth and confidence images with times in their names, a camera file per image.

Sources: ARKitScenes' DATA.md, and its TrajStringToMatrix, by which a line of .traj is the inverse of a pose.
"""

from __future__ import annotations

import functools
import re
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ...core.errors import CaptureError, FrameError
from ...core.image_files import Size
from ...core.transforms import invert
from ...core.warnings import Notice
from ..base import Options
from ..cameras.camera_files import Calibration, is_pose, read_matrix
from ..cameras.lenses import Lens
from ..cameras.rigs import Rig, StatedCameras, build_rig
from ..files.number_files import read_number_rows
from ..files.numbered_files import has_file, list_folder
from ..files.time_pairs import pair_nearest
from ..frame_files import FileFrames, FrameFiles, notice_left_out, read_first_depth_size, read_first_size
from ..images.depth_decoding import MILLIMETERS
from ..poses.frame_poses import ascending_times
from ..rgbd_frames import Registration

REQUIRES: tuple[str, ...] = ()

COLORS = ("lowres_wide", "vga_wide", "wide", "highres_color")
DEPTHS = ("lowres_depth", "highres_depth")

_TIMED = re.compile(r"(?:.*_)?(\d+(?:\.\d+)?)\.(?:png|jpe?g|pincam)", re.IGNORECASE)
_SAME_TIME_S = 0.005
_TRAJ_NUMBERS = 7


@dataclass(frozen=True)
class _Timed:
    """The files of a folder that have a time in their names, by ascending times, seconds."""

    times: NDArray[np.float64]
    files: tuple[Path, ...]


class Reader(FileFrames):
    """Depth is uint16 millimeters, confidence 0, 1, 2. The camera of an image is the ``.pincam`` file nearest in
    time. ``lowres_wide`` is preferred to larger color. Images stay as they are stored, whichever way the device was
    held. Color without depth of the same time is left out, with a warning; frames between those of the trajectory have
    no pose. The path is the folder of the images, or the one above, which may be named after the video.

    Raises CaptureError if no color has depth, or a camera file is unusable.
    """

    format = "arkitscenes"
    layout = "lowres_wide/, lowres_depth/ and lowres_wide_intrinsics/*.pincam"
    parts = ("lowres_wide/*", "lowres_depth/*", "lowres_wide_intrinsics/*.pincam")

    def __init__(self, path: Path, options: Options):
        found = _find(path)
        if found is None:
            raise CaptureError(f"{path} is no scan of ARKitScenes: it lacks one of {self.layout}.")
        root, name = found
        color = _list(root / name)
        depth = next((one for one in map(_list, (root / name for name in DEPTHS)) if one.files), _list(root))
        confidence = _list(root / "confidence")
        depths, notices = _match(color, depth, root, options.depth)
        kept = [row for row, file in enumerate(depths) if file is not None or not options.depth]
        color = _Timed(color.times[kept], tuple(color.files[row] for row in kept))
        depths = [depths[row] for row in kept]
        confidences = _nearest_files(confidence, color.times) if options.depth else [None] * len(kept)
        self._lenses = _list(root / f"{name}_intrinsics")
        self._lens_rows = _nearest_rows(self._lenses.times, color.times)
        color_size = read_first_size(color.files, root)
        depth_size = read_first_depth_size([file for file in depths if file], root) if options.depth else None
        self._rig_of = functools.lru_cache(maxsize=16)(
            lambda file: build_rig(StatedCameras(_read_lens(file)), options, color_size, depth_size)[0]
        )
        rig = self._rig_of(self._lenses.files[self._lens_rows[0]])
        Registration(rig)  # raises CaptureError for a rig of too large images
        poses = _poses(root / f"{name}.traj", root / "lowres_wide.traj", color.times)
        parts = zip(color.files, depths, ascending_times(color.times).tolist(), poses, confidences, strict=True)
        frames = [FrameFiles(image, under, rig, time, pose, conf) for image, under, time, pose, conf in parts]
        super().__init__(path, options, frames, MILLIMETERS)
        self.warnings = notices

    @classmethod
    def recognizes(cls, path: Path) -> bool:
        return _find(path) is not None

    def rig(self, index: int) -> Rig:
        try:
            return self._rig_of(self._lenses.files[self._lens_rows[index]])
        except CaptureError as error:
            raise FrameError(str(error)) from error


def _find(path: Path) -> tuple[Path, str] | None:
    """The folder with the folders of images, and the name of the one of color."""
    names = list_folder(path)
    inside = [name for name in names if name.endswith("_frames")]
    for root, there in ((path, names), *((path / name, list_folder(path / name)) for name in inside[:1])):
        for color in COLORS:
            cameras = root / f"{color}_intrinsics"
            if color in there and not {*DEPTHS}.isdisjoint(there) and has_file(cameras, r".*\.pincam"):
                return root, color
    return None


def _list(folder: Path) -> _Timed:
    matches = [match for name in list_folder(folder) if (match := _TIMED.fullmatch(name))]
    times = np.array([float(match[1]) for match in matches], np.float64)
    order = np.argsort(times, kind="stable").tolist()
    return _Timed(times[order], tuple(folder / matches[row][0] for row in order))


def _match(color: _Timed, depth: _Timed, root: Path, wanted: bool) -> tuple[list[Path | None], tuple[Notice, ...]]:
    """The depth file of each color file, or None, and a warning about the latter. Raises CaptureError if none has
    depth."""
    if not color.files:
        raise CaptureError(f"{root} holds no color images with times in their names.")
    if not wanted:
        return [None] * len(color.files), ()
    found = _nearest_files(depth, color.times)
    alone = [file.name for file, other in zip(color.files, found, strict=True) if other is None]
    if len(alone) == len(color.files):
        raise CaptureError(f"No color image of {root} has depth of the same time: {color.files[0].name} is the first.")
    if not alone:
        return found, ()
    return found, (notice_left_out(len(alone), len(found), root, alone[0], "has no depth of the same time"),)


def _nearest_files(timed: _Timed, times: NDArray[np.float64]) -> list[Path | None]:
    """The file of each time, or None."""
    found: list[Path | None] = [None] * len(times)
    for row, other in pair_nearest(times, timed.times, _SAME_TIME_S).tolist():
        found[row] = timed.files[other]
    return found


def _nearest_rows(times: NDArray[np.float64], wanted: NDArray[np.float64]) -> NDArray[np.int64]:
    """(N,) row of the time nearest to each of N wanted ones."""
    after = np.searchsorted(times, wanted).clip(max=len(times) - 1)
    before = (after - 1).clip(min=0)
    return np.where(np.abs(times[before] - wanted) <= np.abs(times[after] - wanted), before, after)


def _read_lens(file: Path) -> Lens:
    """Raises CaptureError."""
    table = read_matrix(file)
    if table is None or table.shape != (1, 6) or not np.isfinite(table).all():
        raise CaptureError(f"{file} must hold six numbers: width, height, fx, fy, cx, cy.")
    width, height, fx, fy, cx, cy = table[0].tolist()
    size: Size = (round(width), round(height))
    if not 0 < min(size) <= max(size) <= 1_000_000:
        raise CaptureError(f"{file} states an image of {size[0]} x {size[1]} pixels.")
    return Lens(Calibration((fx, fy, cx, cy), size, str(file)).camera(size))


def _poses(own: Path, usual: Path, times: NDArray[np.float64]) -> list[NDArray[np.float64] | None]:
    """The pose of each time, or None. Raises CaptureError for a file that is no trajectory."""
    file = next((file for file in (own, usual) if file.is_file()), None)
    found: list[NDArray[np.float64] | None] = [None] * len(times)
    if file is None:
        return found
    try:
        table = read_number_rows(file).table()
    except ValueError:
        table = None
    if table is None or table.shape[1] != _TRAJ_NUMBERS:
        raise CaptureError(f"{file} must hold lines of {_TRAJ_NUMBERS} numbers: time, turn (axis times angle), place.")
    table = table[np.argsort(table[:, 0], kind="stable")]
    for row, other in pair_nearest(times, table[:, 0], _SAME_TIME_S).tolist():
        T_cam_world = np.eye(4)
        T_cam_world[:3, :3] = cv2.Rodrigues(table[other, 1:4])[0]
        T_cam_world[:3, 3] = table[other, 4:7]
        T = invert(T_cam_world)
        found[row] = T if is_pose(T) else None
    return found
