"""Estimates poses from color alone: structure from motion over the whole scan, or an existing COLMAP model."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated, ClassVar, Literal

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from ...capture.base import Capture
from ...core.errors import ConfigError
from ...core.progress import Progress
from ...core.regular_files import user_path
from ...core.types import Frame, Trajectory
from ...settings.option_types import FilePath
from ..base import KeyframeOptions, PosedPoints, Tracked
from ..given_poses import GivenTracker
from ..sfm.colmap_reconstruction import read_model
from ..sfm.reconstruction import Reconstruction
from ..sfm.structure_from_motion import Recipe, reconstruct_poses

REQUIRES: tuple[str, ...] = ("pycolmap",)


class Options(KeyframeOptions, frozen=True):
    """The frames, how to match and map them, the camera, and an existing model."""

    frames: Annotated[int, Meta(ge=1, le=100_000)] = 300
    """Largest number of frames to reconstruct; of more, the sharpest with equal image motion between them are used."""
    order: Literal["auto", "video", "photos"] = "auto"
    """"video": each frame overlaps the one before; "photos": images in no order; "auto": decide by the images."""
    features: FilePath = "sift"
    """"sift", or the path of an ONNX network for keypoints and descriptors (SuperPoint, DISK, ALIKED)."""
    mapping: Literal["incremental", "global"] = "incremental"
    """"incremental": add image by image; "global": place all at once, which is faster but needs more overlap."""
    intrinsics: Literal["refine", "fixed"] = "refine"
    """"refine": start from the capture's intrinsics; "fixed": keep them unchanged."""
    model: FilePath | None = None
    """Folder of an existing COLMAP model (cameras, images, points3D) of the capture's images to use instead."""


def load(options: Options, capture: Capture) -> ColmapTracker:
    """Load the tracker. It does not read the capture's depth or poses. Raises ConfigError."""
    if options.intrinsics == "fixed" and not capture.intrinsics_known and options.model is None:
        raise ConfigError(
            f"tracking.colmap.intrinsics=fixed needs the camera of {capture.path}: give capture.intrinsics, or set "
            "tracking.colmap.intrinsics=refine."
        )
    return ColmapTracker(options, capture)


class ColmapTracker(GivenTracker):
    """Takes the poses that ``prepare`` finds. Frames that are not selected are "unused", those of smaller models
    "apart". Frames are undistorted to a pinhole camera."""

    world: ClassVar[str] = "OpenCV camera axes of the model's world, in units of half the median depth of its points"
    estimates_camera = True

    def __init__(self, options: Options, capture: Capture):
        super().__init__(np.full((len(capture), 4, 4), np.nan), options.keyframe_overlap)
        self.options = options
        self._capture = capture
        self.offline, self.metric = True, capture.options.scale is not None
        self.reconstruction: Reconstruction | None = None

    def prepare(self, folder: Path, frames: range, progress: Progress) -> None:
        found = self._reconstruct(folder, frames, progress)
        self.reconstruction, self.T_world_cam, self.warnings = found, found.T_world_cam, found.warnings

    def posed_points(self) -> PosedPoints:
        assert self.reconstruction is not None, "prepare comes first"
        found = self.reconstruction
        return PosedPoints(found.T_world_cam, found.points, found.seen_frame, found.seen_point)

    def _reconstruct(self, folder: Path, frames: range, progress: Progress) -> Reconstruction:
        options, scale = self.options, self._capture.options.scale
        if options.model is not None:
            found = read_model(user_path(options.model), self._capture).normalized()
        else:
            recipe = Recipe(options.frames, options.order, options.features, options.mapping, options.intrinsics)
            found = reconstruct_poses(self._capture, frames, folder, recipe, progress)
        return found if scale is None else found.scaled(scale)

    def prepare_frame(self, frame: Frame) -> Frame:
        """Undistort the frame."""
        assert self.reconstruction is not None, "prepare comes first"
        rectified = self.reconstruction.rectified
        return replace(frame, color=rectified.color(frame.color), intrinsics=rectified.intrinsics)

    def track(self, frame: Frame) -> Tracked:
        assert self.reconstruction is not None, "prepare comes first"
        if not self.reconstruction.chosen[frame.index]:
            return Tracked("unused", None, 0.0)
        return super().track(frame)

    def trajectory(self, timestamps: NDArray[np.float64]) -> Trajectory:
        found = super().trajectory(timestamps)
        if self.reconstruction is None or not self.reconstruction.apart.any():
            return found
        status = np.where(self.reconstruction.apart & (found.status == "lost"), "apart", found.status)
        return replace(found, status=status)
