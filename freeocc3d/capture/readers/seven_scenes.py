"""Reads 7-Scenes: frame-000000.color.png (or .jpg), .depth.png and .pose.txt in one folder."""

from __future__ import annotations

import functools
import os
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..base import Options
from ..cameras.camera_files import (
    Calibration,
    check_pose_files,
    read_given_calibration,
    read_intrinsics,
    read_pose,
    rescale_camera,
)
from ..cameras.lenses import Lens
from ..cameras.rigs import Rig
from ..files.numbered_files import has_file, list_numbered
from ..image_pairs import ImagePairs, pair_files

REQUIRES: tuple[str, ...] = ()

COLOR = r"frame-(\d+)\.color\.(?:png|jpe?g)"
POSE = r"frame-(\d+)\.pose\.txt"
DEPTH = r"frame-(\d+)\.depth\.(?:png|tiff?|pgm|pfm|exr|np[yz])"

BUNDLEFUSION = r"_?info\.txt"
"""A file of the format ``bundlefusion``, which has the same names of images."""

KINECT = Calibration((585.0, 585.0, 320.0, 240.0), (640, 480), "the Kinect calibration of 7-Scenes")
"""The calibration on the data set's page; a camera-intrinsics.txt in the folder overrides it."""


class Reader(ImagePairs):
    """Depth is uint16 millimeters, with 0 and 65535 invalid, and has the size of color. Color and depth share the depth
    camera's intrinsics, because the data set registers them only roughly and states no others. Without depth, these
    intrinsics are a guess. Poses are optional and camera-to-world."""

    format = "seven_scenes"
    layout = "frame-N.color.png (or .jpg) with frame-N.depth.png"
    parts = ("frame-*.color.png or frame-*.color.jpg", "frame-*.depth.png")

    def __init__(self, path: Path, options: Options):
        pairs = pair_files(list_numbered(path, COLOR), list_numbered(path, DEPTH), path, options)
        stated = path / "camera-intrinsics.txt"
        calibration = read_given_calibration(options) or (
            read_intrinsics(stated) if os.path.lexists(stated) else KINECT
        )
        camera = calibration.camera(pairs.color_size)
        rig = Rig(Lens(camera), Lens(rescale_camera(camera, pairs.depth_size)))
        super().__init__(path, options, pairs, rig, units_per_meter=1000.0)
        self.intrinsics_known = options.depth or options.intrinsics is not None

    @classmethod
    def recognizes(cls, path: Path) -> bool:
        return has_file(path, COLOR) and not has_file(path, BUNDLEFUSION)

    def pose(self, index: int) -> NDArray[np.float64] | None:
        path = self._pose_files.get(self._pairs.numbers[index])
        return None if path is None else read_pose(path)

    @functools.cached_property
    def _pose_files(self) -> dict[int, Path]:
        files = list_numbered(self.path, POSE)
        check_pose_files(list(files.values()), str(self.path))
        return files
