"""Reads nerfstudio folders: transforms.json with images, poses and, from LiDAR apps, depth.

Source: nerfstudio's "Data conventions".
"""

from __future__ import annotations

import contextlib
import functools
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from ...core.errors import CaptureError, FrameError
from ...core.image_files import Size
from ...core.types import Frame, Intrinsics
from ...core.warnings import Notice
from ..base import Options
from ..cameras.camera_files import Calibration, guess_camera, reduce_camera
from ..cameras.lenses import BROWN_MODELS, PINHOLE_MODELS, Lens, lens_of
from ..cameras.rigs import Rig, StatedCameras, build_rig
from ..files.file_finding import FileFinder, report_missing
from ..frame_files import FileFrames, FrameFiles, read_first_depth_size, read_first_size
from ..image_headers import read_header
from ..images.depth_decoding import SATURATED, RawDepth, read_raw_depth
from ..images.image_decoding import read_color
from ..point_files import read_points
from ..posed_images import PosedImage, PosedImages, compute_nominal_scale, resolve_inside
from ..poses.nerfstudio_files import PosedFrame, Transforms, read_transforms
from ..poses.trajectory_files import poses_of_transforms
from .photos import make_natural_key

REQUIRES: tuple[str, ...] = ()

TRANSFORMS = "transforms.json"

_WITH_ALL_COEFFICIENTS = (*PINHOLE_MODELS, *BROWN_MODELS)
"""Models for which nerfstudio applies all stated coefficients, whichever of these names the file gives."""


class Reader(FileFrames):
    """Frames are in natural order of their file names. The file or each frame states intrinsics, with the origin at the
    corner of the first pixel. Poses are of OpenGL cameras.

    With depth, frames have the depth's pixels, reduced to ``capture.max_size``, and poses are in meters. Depth shows
    what the color shows, with other pixels; its unit is
    ``depth_unit_scale_factor``, or ``integer_depth_scale`` for integers; the one of a frame wins over that of the file.
    A frame without depth has none anywhere. Without depth, frames are those of ``PosedImages``, and ``capture.scale``
    gives meters per unit; without it, the file's points, if any, are scaled to a median depth of ``NOMINAL_DEPTH``,
    unless the file names depth that is not read. Raises CaptureError that names the file and what it lacks.
    """

    format = "nerfstudio"
    layout = f"{TRANSFORMS} with images"
    states_poses = True
    parts = ("transforms.json", "images/*")

    def __init__(self, path: Path, options: Options):
        file = path / TRANSFORMS
        content = read_transforms(file)
        poses = poses_of_transforms(content, file).T_world_cam
        images, left_out = _find([frame.file_path for frame in content.frames], path, "color")
        depths, without_depth = _find([frame.depth_name for frame in content.frames if options.depth], path, "depth")
        views = []
        for row, (frame, T_world_cam) in enumerate(zip(content.frames, poses, strict=True)):
            if (image := images[row]) is not None:
                lens = _lens({**content.stated(), **frame.stated()}, image, file)
                depth = depths[row] if depths else None
                views.append((PosedImage(image, depth, lens, T_world_cam), frame))
        views.sort(key=lambda view: make_natural_key(view[0].image))
        posed = [view for view, _ in views]
        self._views: _Views | None = None
        if any(view.depth is not None for view in posed):
            self._open_depth(path, options, posed, [frame for _, frame in views], content)
        else:
            self._open_views(path, options, posed, content)
        self.warnings = (*left_out, *without_depth)

    @classmethod
    def recognizes(cls, path: Path) -> bool:
        return (path / TRANSFORMS).is_file()

    def __getitem__(self, index: int) -> Frame:
        return super().__getitem__(index) if self._views is None else self._views[index]

    def stored_color(self, index: int) -> NDArray[np.uint8]:
        color, camera = self.frames[index].color, self.rig(index).color.camera
        assert color is not None
        return read_color(color, (camera.width, camera.height), self._color_bits)

    def stored_depth(self, index: int) -> RawDepth | None:
        path, camera = self.frames[index].depth, self.rig(index).depth.camera
        if path is None:
            return None
        raw, own = read_raw_depth(path, self._depth_sizes[index]), self._own_units[index]
        if raw.shape != (camera.height, camera.width):
            raw = cv2.resize(raw, (camera.width, camera.height), interpolation=cv2.INTER_NEAREST_EXACT)
        if own is None or self._common_units is None or own == self._common_units:
            return raw
        measured = raw if raw.dtype != np.uint16 else np.where(raw == SATURATED, 0, raw)
        return measured.astype(np.float32) * np.float32(self._common_units / own)

    def _open_depth(
        self, path: Path, options: Options, posed: Sequence[PosedImage], frames: Sequence[PosedFrame], file: Transforms
    ) -> None:
        rigs, self._depth_sizes = _build_rigs(posed, path, options)
        floats = _holds_floats([view.depth for view in posed if view.depth is not None])
        usual = file.units_per_meter(floats)
        self._own_units = [frame.units_per_meter(floats) or usual for frame in frames]
        stated = [own for own, view in zip(self._own_units, posed, strict=True) if own and view.depth is not None]
        self._common_units = stated[0] if stated and not options.depth_scale else None
        if self._common_units is None:
            self._own_units = [None] * len(posed)
        files = [
            FrameFiles(view.image, view.depth, rig, float(row), view.T_world_cam)
            for row, (view, rig) in enumerate(zip(posed, rigs, strict=True))
        ]
        super().__init__(path, options, files, self._common_units)

    def _open_views(self, path: Path, options: Options, posed: list[PosedImage], content: Transforms) -> None:
        comes_with_depth = any(frame.depth_name is not None for frame in content.frames)
        scale = options.scale
        if scale is None and not comes_with_depth and (points := content.ply_file_path):
            points_file = resolve_inside(path, points.replace("\\", "/"), path / TRANSFORMS)
            scale = compute_nominal_scale(posed, _points(points_file))
        self._views = views = _Views(path, options, posed, scale)
        files = [FrameFiles(view.image, None, Rig(view.lens, view.lens), float(row)) for row, view in enumerate(posed)]
        super().__init__(path, options, files, None)
        self.frames = tuple(replace(file, T_world_cam=views.pose(row)) for row, file in enumerate(self.frames))
        self.has_depth = False
        self.metric_poses = comes_with_depth or options.scale is not None


class _Views(PosedImages):
    """The frames of a folder without depth."""

    format = Reader.format
    layout = Reader.layout

    @classmethod
    def recognizes(cls, path: Path) -> bool:
        return Reader.recognizes(path)


def _build_rigs(posed: Sequence[PosedImage], path: Path, options: Options) -> tuple[list[Rig], list[Size]]:
    """The rig of each frame, and the size of its depth file. Frames of one stated size have files of one size, which
    may be another. Raises CaptureError."""
    groups: dict[Size, list[PosedImage]] = {}
    for view in posed:
        groups.setdefault((view.lens.camera.width, view.lens.camera.height), []).append(view)
    every = [view.depth for view in posed if view.depth]
    sizes = {}
    for size, views in groups.items():
        own = [view.depth for view in views if view.depth] or every
        sizes[size] = read_first_size([view.image for view in views], path), read_first_depth_size(own, path)

    @functools.cache
    def build(lens: Lens) -> tuple[Rig, Size]:
        color_size, depth_size = sizes[lens.camera.width, lens.camera.height]
        reduced = reduce_camera(guess_camera(depth_size), options.max_size)
        return build_rig(StatedCameras(lens), options, color_size, (reduced.width, reduced.height))[0], depth_size

    built = [build(view.lens) for view in posed]
    return [rig for rig, _ in built], [size for _, size in built]


def _holds_floats(paths: Sequence[Path]) -> bool:
    """Whether the first readable depth holds floats."""
    for path in paths:
        with contextlib.suppress(FrameError):
            return bool(read_raw_depth(path).dtype.kind == "f")
    return False


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
