"""Reads Replica as NICE-SLAM packs it: results/frame000000.jpg and depth000000.png, traj.txt, cam_params.json."""

from __future__ import annotations

import functools
import os
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np
from numpy.typing import NDArray

from ...core.errors import CaptureError
from ..base import Options
from ..cameras.camera_files import (
    Calibration,
    Number,
    PositiveNumber,
    guess_camera,
    is_pose,
    read_given_calibration,
    read_json,
    rescale_camera,
)
from ..cameras.lenses import Lens
from ..cameras.rigs import Rig
from ..class_files import capture_class_names
from ..files.number_files import read_number_rows
from ..files.numbered_files import has_file, list_numbered
from ..image_pairs import ImagePairs, pair_files

REQUIRES: tuple[str, ...] = ()

COLOR = r"frame(\d+)\.(?:png|jpe?g)"
DEPTH = r"depth(\d+)\.(?:png|tiff?|pgm|pfm|exr|np[yz])"
CLASSES = r"semantic_class_(\d+)\.png"

UNITS_PER_METER = 6553.5
"""Depth units per meter of the published Replica renderings; ``scale`` in cam_params.json overrides it."""


DepthUnits = Annotated[float, msgspec.Meta(ge=1e-3, le=1e9)]


class _Camera(msgspec.Struct):
    """The camera of cam_params.json. scale: depth units per meter."""

    w: PositiveNumber
    h: PositiveNumber
    fx: Number
    fy: Number
    cx: Number
    cy: Number
    scale: DepthUnits = UNITS_PER_METER


class _Parameters(msgspec.Struct):
    camera: _Camera


class Reader(ImagePairs):
    """Depth in meters is the stored value / ``scale``. ``cam_params.json`` lies in the folder or, as in NICE-SLAM's
    package, in its parent folder. The lines of ``traj.txt`` are poses: row-major, camera-to-world, OpenCV axes. This
    file is optional, and opened only when a pose is requested. Class images are optional:
    ``semantic_class/semantic_class_N.png`` hold indices into the names of ``classes.json``."""

    format = "replica"
    layout = "results/frameN.jpg (or .png) with results/depthN.png and cam_params.json"
    parts = ("results/frame*.jpg or results/frame*.png", "results/depth*.png", "cam_params.json")

    def __init__(self, path: Path, options: Options):
        results = path / "results"
        pairs = pair_files(list_numbered(results, COLOR), list_numbered(results, DEPTH), results, options)
        calibration, units_per_meter = _parameters(path, options)
        camera = calibration.camera(pairs.color_size) if calibration else guess_camera(pairs.color_size)
        rig = Rig(Lens(camera), Lens(rescale_camera(camera, pairs.depth_size)))
        super().__init__(path, options, pairs, rig, units_per_meter)
        self.intrinsics_known = self.focal_stated = calibration is not None
        self.classes = capture_class_names(path)

    @classmethod
    def recognizes(cls, path: Path) -> bool:
        return has_file(path / "results", COLOR)

    def pose(self, index: int) -> NDArray[np.float64] | None:
        """As in ``Capture``. Raises CaptureError if the lines of traj.txt do not fit the frames."""
        if self._trajectory is None:
            return None
        # Line n is the n-th file or, if files were removed, the file with number n.
        row = index if len(self._trajectory) == len(self) else self._pairs.numbers[index]
        T_world_cam = self._trajectory[row]
        return T_world_cam if is_pose(T_world_cam) else None

    def labels(self, index: int) -> NDArray[np.uint8] | None:
        return self._class_image(index, self._class_files.get(self._pairs.numbers[index]))

    @functools.cached_property
    def _class_files(self) -> dict[int, Path]:
        return list_numbered(self.path / "semantic_class", CLASSES)

    @functools.cached_property
    def _trajectory(self) -> NDArray[np.float64] | None:
        """(L, 4, 4) poses, one per line of traj.txt; None without this file."""
        path = self.path / "traj.txt"
        if not os.path.lexists(path):
            return None
        try:
            table = read_number_rows(path).table()
        except ValueError:
            table = None
        if table is None or table.shape[1] != 16:
            raise CaptureError(f"{path} must hold 16 numbers per line: correct or remove it.")
        poses = table.reshape(-1, 4, 4)
        if len(poses) != len(self) and len(poses) <= self._pairs.numbers[-1]:
            raise CaptureError(f"{path} holds {len(poses)} poses for {len(self)} frames: correct or remove it.")
        return poses


def _parameters(path: Path, options: Options) -> tuple[Calibration | None, float]:
    """Color camera and depth units per meter. The camera may be None if depth is not read. Raises CaptureError."""
    override = read_given_calibration(options)
    file = next((f for f in (path / "cam_params.json", path.parent / "cam_params.json") if os.path.lexists(f)), None)
    if file is None:
        if override is None and options.depth:
            raise CaptureError(
                f"There is no cam_params.json in {path} or its parent folder: add it, or give capture.intrinsics "
                "(and capture.depth_scale)."
            )
        return override, UNITS_PER_METER
    camera = read_json(file, _Parameters).camera
    values, size = (camera.fx, camera.fy, camera.cx, camera.cy), (int(camera.w), int(camera.h))
    return override or Calibration(values, size, str(file)), camera.scale
