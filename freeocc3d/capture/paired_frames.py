"""RGB-D frames of color and depth files that lists or the names of the files pair."""

from __future__ import annotations

import functools
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..core.errors import CaptureError, FrameError
from ..core.image_files import Size
from ..core.sampling import spread_evenly
from .base import Options
from .cameras.camera_discovery import FoundCameras, find_cameras, find_frame_files
from .cameras.camera_documents import read_cameras
from .cameras.lenses import Lens
from .cameras.rigs import Rig, StatedCameras, build_rig
from .files.paired_folders import PairList
from .frame_files import FileFrames, FrameFiles, build_file_rig, read_first_depth_size, read_first_size
from .images.depth_decoding import read_raw_depth
from .poses.paired_poses import assign_poses, find_pose_file, read_pose_folder, usable_pose
from .poses.trajectory_files import read_trajectory
from .rgbd_frames import Registration

ICL_NUIM = ".freiburg"
"""Suffix of ICL-NUIM's poses, as in livingRoom0.gt.freiburg."""

_MIRROR = np.diag((1.0, -1.0, 1.0, 1.0))
_SAMPLES = 3
_KEPT_RIGS = 1024


class PairedFrames(FileFrames):
    """Frames of a list of pairs by one rig. Cameras and the depth unit come from files beside the images, poses from a
    folder or a file, which is read when the first pose is requested."""

    def __init__(
        self,
        path: Path,
        options: Options,
        frames: PairList,
        usual: Lens | None = None,
        units_per_meter: float | None = None,
        pose_folder: Path | None = None,
        mirrored: bool = False,
    ):
        """usual: the camera of color and depth, if no file states another.  units_per_meter: likewise of depth.
        mirrored: the y axes of the poses and of their world point up in a left-handed frame, as those of ICL-NUIM."""
        color = [pair.color for pair in frames.pairs]
        depth = [pair.depth for pair in frames.pairs if pair.depth is not None]
        color_size = read_first_size(color, path)
        depth_size = read_first_depth_size(depth, path) if depth else None
        _check_depth(depth, path)
        own = find_frame_files(path, [file.name for file in color])
        self._own_cameras, folder = _own_cameras(own, options)
        found = _cameras(path, options, color_size, depth_size, usual, folder)
        rig, known, rough = build_file_rig(found.stated, options, color, color_size, depth_size)
        self.intrinsics_known, self.focal_stated = (one or bool(self._own_cameras) for one in (known, rough))
        self._sizes, self._rig = (color_size, depth_size), functools.lru_cache(_KEPT_RIGS)(self._read_rig)
        Registration(rig)  # raises CaptureError for a rig of too large images
        files = [
            FrameFiles(pair.color, pair.depth, rig, pair.time, confidence=pair.confidence) for pair in frames.pairs
        ]
        super().__init__(path, options, files, found.units_per_meter or units_per_meter)
        self.warnings = frames.notices
        self._listed, self._pose_folder, self._mirrored = frames, pose_folder, mirrored

    def rig(self, index: int) -> Rig:
        """As in ``RgbdFrames``. Raises FrameError if the frame's own calibration is not usable."""
        own = self._own_cameras.get(index)
        return self.frames[index].rig if own is None else self._rig(own)

    def _read_rig(self, file: Path) -> Rig:
        (color_size, depth_size) = self._sizes
        try:
            document = read_cameras(file)
            if document is None or document.color is None:
                raise FrameError(f"{file} states no camera that is understood.")
            depth = document.depth.lens(depth_size) if document.depth and depth_size else None
            stated = StatedCameras(document.color.lens(color_size), depth, document.T_color_depth)
            return build_rig(stated, self.options, color_size, depth_size)[0]
        except CaptureError as error:
            raise FrameError(str(error)) from error

    def pose(self, index: int) -> NDArray[np.float64] | None:
        """As in ``Capture``. Raises CaptureError if the poses do not fit the frames."""
        return self._poses[index]

    @functools.cached_property
    def _poses(self) -> list[NDArray[np.float64] | None]:
        if self._pose_folder is not None:
            return read_pose_folder(self._pose_folder, self._listed)
        file = find_pose_file(self.path)
        if file is None:
            return [None] * len(self)
        T_world_cam = assign_poses(read_trajectory(file), self._listed)
        if self._mirrored or file.suffix.lower() == ICL_NUIM:
            T_world_cam = _MIRROR @ T_world_cam @ _MIRROR
        return [usable_pose(T) for T in T_world_cam]


def _own_cameras(files: dict[int, Path], options: Options) -> tuple[dict[int, Path], Path | None]:
    """The calibration files of frames, and their folder; a given camera replaces them."""
    folder = next((file.parent for file in files.values()), None)
    return ({} if options.intrinsics or options.focal else files), folder


def _cameras(
    path: Path, options: Options, color_size: Size, depth_size: Size | None, usual: Lens | None, skipped: Path | None
) -> FoundCameras:
    """What files state; a given color camera replaces a file that is not usable."""
    try:
        found = find_cameras(path, color_size, depth_size, skipped)
    except CaptureError:
        if not (options.intrinsics or options.focal):
            raise
        return FoundCameras(StatedCameras())
    if usual is not None and found.stated.color is None and found.stated.depth is None:
        return FoundCameras(StatedCameras(color=usual), found.units_per_meter)
    return found


def _check_depth(depth: list[Path], path: Path) -> None:
    """Raise CaptureError if the files hold no depth, such as pictures of it, according to a few of them."""
    reason = ""
    for row in spread_evenly(len(depth), _SAMPLES):
        try:
            read_raw_depth(depth[row])
        except FrameError as error:
            reason = reason or str(error)
        else:
            return
    if reason:
        raise CaptureError(
            f"The depth of {path} cannot be used: {reason} Give depth of 16 bits or floats, or map color only with "
            "capture.depth=false."
        )
