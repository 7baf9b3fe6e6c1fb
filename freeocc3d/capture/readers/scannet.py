"""Reads exported ScanNet scenes and RealSense recordings: color/N.jpg, depth/N.png, intrinsic/, optional pose/N.txt."""

from __future__ import annotations

import functools
import os
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...core.errors import CaptureError
from ...core.transforms import invert
from ..base import Options
from ..cameras.camera_discovery import find_cameras
from ..cameras.camera_files import check_pose_files, read_intrinsics, read_pose, read_rigid
from ..cameras.lenses import Lens
from ..cameras.rigs import StatedCameras
from ..class_files import capture_class_names
from ..files.numbered_files import has_file, list_numbered
from ..files.paired_folders import find_folders
from ..frame_files import build_file_rig
from ..image_lists import find_lists
from ..image_pairs import ImagePairs, Pairs, pair_files

REQUIRES: tuple[str, ...] = ()

# Exactly one number in the name: a timestamp in seconds has two. Hidden files (._7.jpg) are not images.
NUMBER = r"(?:[^.\d]\D*)?(\d+)"
COLOR = rf"{NUMBER}\.(?:png|jpe?g)"
IMAGE = rf"{NUMBER}\.png"
DEPTH = rf"{NUMBER}\.(?:png|tiff?|pgm|pfm|exr|np[yz])"
POSE = rf"{NUMBER}\.txt"

COLOR_CAMERA = ("intrinsic/intrinsic_color.txt", "intrinsic_color.txt")
DEPTH_CAMERA = ("intrinsic/intrinsic_depth.txt", "intrinsic_depth.txt")
ONE_CAMERA = ("intrinsic/intrinsic.txt", "intrinsic.txt", "intrinsic.json", "camera_intrinsic.json")
"""Files of a camera that color and depth share; the JSON files are Open3D's."""


MOST_ALONE, MOST_ALONE_STATED = 0.1, 0.7
"""Folders of which more images lack their partner are paired in other ways, such as by time; the second with
``intrinsic/``, which few other layouts have."""


class Reader(ImagePairs):
    """Depth is stored in millimeters, unless this makes no room of the scan. Numbers in names have no leading zeros and
    sort as numbers. ``pose/`` is optional and holds camera-to-world poses; -inf means no pose.

    ``intrinsic/intrinsic_color.txt`` and ``intrinsic_depth.txt`` hold the color and depth cameras (4 x 4 or 3 x 3). If
    one is missing, it is derived from the other, provided that the images have the same aspect ratio; if both are, a
    file of another form may state the camera (see ``camera_discovery``).
    ``extrinsic_color.txt`` and ``extrinsic_depth.txt`` in the same folder map each camera to the rig. If they differ,
    depth moves to the color camera; otherwise color is resampled to the depth pixels (see ``depth_registration``). With
    ``capture.depth=false`` color stays unchanged.

    If the folder has a ``classes.json``, ``label-filt/N.png`` are class images that hold indices into its names.
    """

    format = "scannet"
    layout = "color/N.jpg (or .png) with depth/N.png and intrinsic/intrinsic_color.txt"
    parts = ("color/*.jpg or color/*.png", "depth/*.png", "intrinsic/intrinsic_color.txt")

    def __init__(self, path: Path, options: Options):
        pairs = pair_files(list_numbered(path / "color", COLOR), list_numbered(path / "depth", DEPTH), path, options)
        rig, self.intrinsics_known, self.focal_stated = build_file_rig(
            _stated_cameras(path, pairs, options.depth),
            options,
            [file for file in pairs.color if file is not None],
            pairs.color_size,
            pairs.depth_size if options.depth else None,
        )
        super().__init__(path, options, pairs, rig, units_per_meter=None)
        self.classes = capture_class_names(path)

    @classmethod
    def recognizes(cls, path: Path) -> bool:
        if not has_file(path / "color", COLOR):
            return False
        stated = (path / "intrinsic").is_dir()
        if not stated and find_lists(path).usable:
            return False
        try:
            color, depth = list_numbered(path / "color", COLOR), list_numbered(path / "depth", DEPTH)
        except CaptureError:  # two files of one frame, which the constructor tells
            return True
        if not depth:
            return find_folders(path) is None  # else depth lies in a folder of another name
        few = MOST_ALONE_STATED if stated else MOST_ALONE
        return len(color.keys() ^ depth.keys()) <= few * len(color.keys() | depth.keys())

    def pose(self, index: int) -> NDArray[np.float64] | None:
        path = self._pose_files.get(self._pairs.numbers[index])
        return None if path is None else read_pose(path)

    def labels(self, index: int) -> NDArray[np.uint8] | None:
        return self._class_image(index, self._class_files.get(self._pairs.numbers[index]))

    @functools.cached_property
    def _pose_files(self) -> dict[int, Path]:
        files = list_numbered(self.path / "pose", POSE)
        check_pose_files(list(files.values()), str(self.path / "pose"))
        return files

    @functools.cached_property
    def _class_files(self) -> dict[int, Path]:
        return list_numbered(self.path / "label-filt", IMAGE)


def _stated_cameras(path: Path, pairs: Pairs, with_depth: bool) -> StatedCameras:
    """What the files state about the two cameras. Raises CaptureError for an unusable file."""
    color = _first(path, (*COLOR_CAMERA, *ONE_CAMERA))
    depth = _first(path, DEPTH_CAMERA) if with_depth else None
    if color is None and depth is None:
        return find_cameras(path, pairs.color_size, pairs.depth_size if with_depth else None).stated
    return StatedCameras(
        Lens(read_intrinsics(color).camera(pairs.color_size)) if color else None,
        Lens(read_intrinsics(depth).camera(pairs.depth_size)) if depth else None,
        _T_color_depth(path),
    )


def _T_color_depth(path: Path) -> NDArray[np.float64] | None:
    """(4, 4) depth to color camera frame; None without extrinsics, because the two then coincide."""
    color, depth = (
        _first(path, (f"intrinsic/extrinsic_{camera}.txt", f"extrinsic_{camera}.txt")) for camera in ("color", "depth")
    )
    if color is None and depth is None:
        return None
    T_rig_color, T_rig_depth = (np.eye(4) if file is None else read_rigid(file) for file in (color, depth))
    return invert(T_rig_color) @ T_rig_depth


def _first(path: Path, names: Iterable[str]) -> Path | None:
    return next((path / name for name in names if os.path.lexists(path / name)), None)
