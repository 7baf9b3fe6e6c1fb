"""Images with poses and lenses, and optional depth; the readers of reconstructions share it."""

from __future__ import annotations

import functools
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..core.errors import CaptureError, FrameError
from ..core.transforms import invert, project, transform
from ..core.types import Frame
from .base import NOMINAL_DEPTH, Capture, Options
from .cameras.camera_files import read_given_calibration, rescale_camera
from .cameras.lenses import Lens
from .cameras.undistortion import Rectified
from .images.depth_decoding import RawDepth, convert_to_meters, read_raw_depth
from .images.image_decoding import read_color

UNITS_PER_METER = 1000.0
"""Units per meter of stored depth, unless ``capture.depth_scale`` is set."""

_SAMPLES = 20_000


@dataclass(frozen=True)
class PosedImage:
    """An image file, its depth file or None, its lens, and (4, 4) T_world_cam."""

    image: Path
    depth: Path | None
    lens: Lens
    T_world_cam: NDArray[np.float64]


class PosedImages(Capture):
    """Undistorts images to pinhole cameras and reduces them to ``capture.max_size``. Each image may have its own
    camera."""

    states_poses = True

    def __init__(self, path: Path, options: Options, posed: Sequence[PosedImage], units_in_meters: float | None):
        """units_in_meters: meters per unit of the poses; None = unknown, and the poses stay unchanged."""
        super().__init__(path, options)
        if len(posed) < 2:
            raise CaptureError(f"{path} holds {len(posed)} image{'s' * (not posed)} with a pose: a scan needs many.")
        self.has_depth = options.depth and any(view.depth is not None for view in posed)
        self.timestamps = np.arange(len(posed), dtype=np.float64)
        scale = 1.0 if units_in_meters is None else units_in_meters
        self._posed = [replace(view, T_world_cam=_scaled(view.T_world_cam, scale)) for view in posed]
        self._rectified = functools.lru_cache(maxsize=4)(lambda lens: Rectified(lens, options.max_size))
        if stated := read_given_calibration(options):
            cameras = {lens.camera for lens in (view.lens for view in posed)}
            lenses = {camera: Lens(stated.camera((camera.width, camera.height))) for camera in cameras}
            self._posed = [replace(view, lens=lenses[view.lens.camera]) for view in self._posed]

    def __getitem__(self, index: int) -> Frame:
        if not 0 <= index < len(self):
            raise IndexError(f"Frame {index} of {len(self)} images.")
        view = self._posed[index]
        color = read_color(view.image)
        lens = view.lens
        size = color.shape[1], color.shape[0]
        if size != (lens.camera.width, lens.camera.height):  # the stored image is smaller or larger
            try:
                lens = replace(lens, camera=rescale_camera(lens.camera, size))
            except CaptureError as error:
                raise FrameError(
                    f"{view.image} has {size[0]} x {size[1]} pixels, but its camera has {lens.camera.width} x "
                    f"{lens.camera.height}."
                ) from error
        try:
            rectified = self._rectified(lens)
        except CaptureError as error:
            raise FrameError(f"{view.image} cannot be undistorted: {error}") from error
        depth_m = np.zeros(rectified.size[::-1], np.float32)
        if self.has_depth and view.depth is not None:
            units = self.options.depth_scale or UNITS_PER_METER
            depth_m = rectified.depth(convert_to_meters(read_raw_depth(view.depth), units, self.options.max_depth))
        return Frame(index, float(self.timestamps[index]), rectified.color(color), depth_m, rectified.intrinsics)

    def raw_depth(self, index: int) -> tuple[RawDepth, float] | None:
        path = self._posed[index].depth
        if path is None or not self.has_depth:
            return None
        return read_raw_depth(path), self.options.depth_scale or UNITS_PER_METER

    def name(self, index: int) -> str:
        return self._posed[index].image.name

    def files(self, index: int) -> tuple[Path, ...]:
        view = self._posed[index]
        return (view.image,) if view.depth is None or not self.has_depth else (view.image, view.depth)

    def pose(self, index: int) -> NDArray[np.float64]:
        return self._posed[index].T_world_cam


def compute_nominal_scale(posed: Sequence[PosedImage], points: NDArray[np.float64]) -> float | None:
    """Factor that brings the median depth of (P, 3) points seen in images to ``NOMINAL_DEPTH``; None without any."""
    points = points[:: max(1, len(points) // _SAMPLES)]
    depths = []
    for view in posed:
        camera = view.lens.camera
        pixels, depth = project(transform(invert(view.T_world_cam), points), camera)
        seen = (pixels >= 0).all(axis=1) & (pixels[:, 0] < camera.width) & (pixels[:, 1] < camera.height)
        if seen.any():
            depths.append(float(np.median(depth[seen])))
    return NOMINAL_DEPTH / float(np.median(depths)) if depths else None


def resolve_inside(folder: Path, name: str, stated_by: Path) -> Path:
    """The path of a file that ``stated_by`` names. Raises CaptureError if it lies outside ``folder``."""
    path = Path(os.path.normpath(folder / name))
    if not path.is_relative_to(os.path.normpath(folder)):
        raise CaptureError(f"{stated_by} names {name}, which lies outside {folder}: correct it.")
    return path


def _scaled(T_world_cam: NDArray[np.float64], scale: float) -> NDArray[np.float64]:
    T = T_world_cam.copy()
    T[:3, 3] *= scale
    return T
