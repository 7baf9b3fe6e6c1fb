"""Reads nerfstudio folders: transforms.json with images, poses and, from LiDAR apps, depth.

Source: nerfstudio's "Data conventions".
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from ...core.errors import CaptureError
from ...core.types import Intrinsics
from ...core.warnings import Notice
from ..base import Options
from ..camera_files import Calibration
from ..file_finding import FileFinder, report_missing
from ..lenses import BROWN_MODELS, PINHOLE_MODELS, Lens, lens_of
from ..nerfstudio_files import read_transforms
from ..point_files import read_points
from ..posed_images import PosedImage, PosedImages, compute_nominal_scale, resolve_inside
from ..trajectory_files import read_trajectory
from .photos import make_natural_key, read_header

REQUIRES: tuple[str, ...] = ()

TRANSFORMS = "transforms.json"

_WITH_ALL_COEFFICIENTS = (*PINHOLE_MODELS, *BROWN_MODELS)
"""Models for which nerfstudio applies all stated coefficients, whichever of these names the file gives."""


class Reader(PosedImages):
    """Frames are in natural order of their file names. The file or each frame states intrinsics, with the origin at the
    corner of the first pixel. Poses are of OpenGL cameras. Depth is 16-bit millimeters, of any size.

    If the file names depth, poses are in meters, even if depth is not read. Otherwise ``capture.scale`` gives meters
    per unit; without it, the file's points, if any, are scaled to a median depth of ``NOMINAL_DEPTH``. Raises
    CaptureError that names the file and what it lacks.
    """

    format = "nerfstudio"
    layout = f"{TRANSFORMS} with images"

    def __init__(self, path: Path, options: Options):
        file = path / TRANSFORMS
        content = read_transforms(file)
        poses = read_trajectory(file).T_world_cam  # also checks that they are rigid
        images, left_out = _find([frame.file_path for frame in content.frames], path, "color")
        depths, without_depth = _find(
            [frame.depth_file_path for frame in content.frames if options.depth], path, "depth"
        )
        posed = []
        for row, (frame, T_world_cam) in enumerate(zip(content.frames, poses, strict=True)):
            if (image := images[row]) is not None:
                lens = _lens({**content.stated(), **frame.stated()}, image, file)
                posed.append(PosedImage(image, depths[row] if depths else None, lens, T_world_cam))
        posed.sort(key=lambda view: make_natural_key(view.image))
        comes_with_depth = any(frame.depth_file_path is not None for frame in content.frames)
        scale = options.scale
        if scale is None and not comes_with_depth and (points := content.ply_file_path):
            scale = compute_nominal_scale(posed, _points(resolve_inside(path, points.replace("\\", "/"), file)))
        super().__init__(path, options, posed, scale)
        self.metric_poses = comes_with_depth or options.scale is not None
        self.warnings = (*left_out, *without_depth)

    @classmethod
    def recognizes(cls, path: Path) -> bool:
        return (path / TRANSFORMS).is_file()


def _find(
    names: Sequence[str | None], path: Path, kind: Literal["color", "depth"]
) -> tuple[list[Path | None], tuple[Notice, ...]]:
    """The file of each name, None without one, and a warning about names without a file. Raises CaptureError."""
    finder = FileFinder(path, kind)
    stated = [name for name in names if name is not None]
    files = finder.find_all(stated)
    what = "images" if kind == "color" else "depth images"
    notices = report_missing(stated, files, finder, TRANSFORMS, what) if len(stated) > 1 else ()
    found = iter(files)
    return [None if name is None else next(found) for name in names], notices


def _points(file: Path) -> NDArray[np.float64]:
    """(P, 3) points of a PLY file. Points are optional: a missing or damaged file gives none."""
    try:
        return read_points(file)
    except CaptureError:
        return np.zeros((0, 3))


def _lens(stated: Mapping[str, Any], image: Path, file: Path) -> Lens:
    """The lens that a frame states. Raises CaptureError."""
    model = "OPENCV_FISHEYE" if stated.get("is_fisheye") else str(stated.get("camera_model", "OPENCV")).upper()
    model = "OPENCV" if model in _WITH_ALL_COEFFICIENTS else model
    width, height = int(stated.get("w", 0)), int(stated.get("h", 0))
    if min(width, height) <= 0:
        header = read_header(image)
        if header is None:
            raise CaptureError(f"{file} states no size (w, h), and its image {image} cannot be read.")
        width, height = header.size if header.orientation < 5 else header.size[::-1]
    fx = stated.get("fl_x") or _focal(stated.get("camera_angle_x"), width)
    if fx is None:
        raise CaptureError(f"{file} states no focal length: add fl_x or camera_angle_x.")
    fy = stated.get("fl_y") or fx
    cx, cy = stated.get("cx", width / 2), stated.get("cy", height / 2)
    names = ("k1", "k2", "k3", "k4") if model == "OPENCV_FISHEYE" else ("k1", "k2", "k3", "k4", "p1", "p2")
    coefficients = {name: stated.get(name, 0.0) for name in names}
    camera: Intrinsics = Calibration((fx, fy, cx - 0.5, cy - 0.5), (width, height), str(file)).camera((width, height))
    return lens_of(model, camera, coefficients, str(file))


def _focal(view: float | None, width: int) -> float | None:
    """Focal length of a view of that many radians across the width; None if there is none, or no camera has it."""
    return 0.5 * width / math.tan(0.5 * view) if view is not None and 0 < view < math.pi else None
