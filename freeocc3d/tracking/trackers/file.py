"""Takes another system's poses from a file: TUM, KITTI, Open3D .log, COLMAP, nerfstudio, 7-Scenes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from ...capture import read_trajectory
from ...capture.base import Capture
from ...capture.point_files import read_points
from ...core.errors import ConfigError, TrackingError
from ...core.transforms import invert, project, transform
from ...core.types import Frame
from ...settings.option_types import Positive
from ..base import KeyframeOptions
from ..given_poses import GivenTracker
from ..rgbd import orb_features
from ..rgbd.keyframe_registration import decode_keyframe_view

REQUIRES: tuple[str, ...] = ("open3d",)

_PAIRS, _LEAST_PAIRS = 24, 6
_LEAST_STEP = 0.05  # of the depth: a shorter way between two frames tells no scale
_TOLERATED = 1.1  # of the scale, either way
_CELL = 8  # pixels; in one of them a cloud's points hide what lies behind
_BEHIND = 0.05  # of the depth


class Options(KeyframeOptions, frozen=True):
    """Which file, how its poses are told apart, its scale, and a point cloud that came with it."""

    path: str = ""
    """The trajectory: a file, or a folder of 7-Scenes' poses or with a COLMAP model; also looked for in the capture."""
    max_time_difference: Positive = 0.02
    """Seconds by which a pose and its frame may differ, for files that state times."""
    scale: Positive | None = 1.0
    """Meters per unit of the file; null = as the capture's depth says, for monocular systems, and without depth as
    capture.scale says, else unknown."""
    points: str | None = None
    """Point cloud (PLY, PCD, XYZ) in the file's world: where a frame has no depth, its points are the anchors."""


def load(options: Options, capture: Capture) -> FileTracker:
    """The tracker that reads ``options.path``.

    Raises ConfigError (no path), CaptureError (a file that cannot be read or has no pose of this capture),
    TrackingError (a scale that the depth contradicts).
    """
    if not options.path:
        raise ConfigError("tracking.backend=file needs tracking.file.path, the trajectory that is to be taken.")
    found = read_trajectory(_beside(options.path, capture))
    T_world_cam = found.of_frames(capture, options.max_time_difference)
    points = None if options.points is None else read_points(_beside(options.points, capture)).astype(np.float32)
    scale = _scale(T_world_cam, capture, options)
    T_world_cam[:, :3, 3] *= scale
    scaled = None if points is None else points * np.float32(scale)
    tracker = FileTracker(T_world_cam, options.keyframe_overlap, scaled)
    tracker.metric = capture.has_depth or options.scale is not None or capture.options.scale is not None
    return tracker


class FileTracker(GivenTracker):
    """The world frame is the file's, in meters. With a point cloud, (P, 3) world, frames get its depth where they have
    none of their own."""

    world: ClassVar[str] = "world frame of the trajectory file, scaled to meters"

    def __init__(
        self,
        T_world_cam: NDArray[np.float64],
        keyframe_overlap: float,
        points: NDArray[np.float32] | None = None,
    ):
        super().__init__(T_world_cam, keyframe_overlap)
        self._points = points
        self.brings_depth = points is not None

    def prepare_frame(self, frame: Frame) -> Frame:
        T_world_cam = self.T_world_cam[frame.index]
        if self._points is None or not np.isfinite(T_world_cam).all():
            return frame
        depth_m = project_depth(transform(invert(T_world_cam), self._points), frame)
        return replace(frame, depth_m=np.where(frame.depth_m > 0, frame.depth_m, depth_m))


def project_depth(points_cam: NDArray[np.float32], frame: Frame) -> NDArray[np.float32]:
    """(H, W) meters: (P, 3) camera-frame points at the pixels where they fall, the nearest first; 0 elsewhere. A cloud
    has gaps, so points far behind others in a neighborhood of pixels count as hidden."""
    camera = frame.intrinsics
    front = points_cam[points_cam[:, 2] > 0.05]
    pixels, z = project(front, camera)
    u, v = np.rint(pixels).astype(np.int64).T
    inside = (u >= 0) & (v >= 0) & (u < camera.width) & (v < camera.height)
    u, v, z = u[inside], v[inside], z[inside].astype(np.float32)
    nearest = np.full((camera.height // _CELL + 1, camera.width // _CELL + 1), np.inf, np.float32)
    np.minimum.at(nearest, (v // _CELL, u // _CELL), z)
    seen = z <= (1 + _BEHIND) * nearest[v // _CELL, u // _CELL]
    depth_m = np.full((camera.height, camera.width), np.inf, np.float32)
    np.minimum.at(depth_m, (v[seen], u[seen]), z[seen])
    return np.where(np.isfinite(depth_m), depth_m, np.float32(0))


def _beside(path: str, capture: Capture) -> Path:
    """The path as given, or, where there is no such file, in the capture's folder or beside the video."""
    given = Path(path).expanduser()
    inside = (capture.path.parent if capture.path.is_file() else capture.path) / given
    return inside if not given.exists() and inside.exists() else given


def _scale(T_world_cam: NDArray[np.float64], capture: Capture, options: Options) -> float:
    """Meters per unit, from the options, checked against what depth says, or from depth; 1 where nothing says it."""
    if not capture.has_depth:
        return capture.options.scale or options.scale or 1.0
    measured = estimate_depth_scale(T_world_cam, capture)
    if options.scale is None:
        if measured is None:
            raise TrackingError(
                f"The scale of {options.path} cannot be told from the depth of {capture.path}: too few frames with a "
                "pose and depth show the same; give tracking.file.scale."
            )
        return measured
    off = None if measured is None else max(measured / options.scale, options.scale / measured)
    if off is not None and off > _TOLERATED:
        raise TrackingError(
            f"By the depth of {capture.path} a unit of {options.path} is {measured:.3g} m, not {options.scale:g} m: "
            "give tracking.file.scale, null to take what depth says, or check that the file is this capture's."
        )
    return options.scale


def estimate_depth_scale(T_world_cam: NDArray[np.float64], capture: Capture) -> float | None:
    """Meters per unit of (N, 4, 4) poses by the capture's depth; None where too little tells.

    Where two frames match features with depths p_s, p_t, p_t = R p_s + scale t: each match gives a scale along t, and
    the median over a pair, then over pairs, is taken.
    """
    posed = np.flatnonzero(np.isfinite(T_world_cam).all(axis=(1, 2)))
    scales = []
    for start in np.unique(np.linspace(0, max(len(posed) - 2, 0), _PAIRS).astype(int)).tolist():
        if len(posed) < 2:
            break
        found = _pair_scale(T_world_cam, capture, posed[start:])
        if found is not None:
            scales.append(found)
    return float(np.median(scales)) if len(scales) >= _LEAST_PAIRS else None


def _pair_scale(T_world_cam: NDArray[np.float64], capture: Capture, frames: NDArray[np.int64]) -> float | None:
    target = decode_keyframe_view(capture, int(frames[0]))
    for gap in (12, 6, 3, 1):
        source = decode_keyframe_view(capture, int(frames[gap])) if target is not None and gap < len(frames) else None
        if target is None or source is None:
            continue
        rows = orb_features.match_binary(source.features, target.features)
        p_s, p_t = source.points[rows[:, 0]].astype(np.float64), target.points[rows[:, 1]].astype(np.float64)
        known = (p_s[:, 2] > 0) & (p_t[:, 2] > 0)
        T = invert(T_world_cam[frames[0]]) @ T_world_cam[frames[gap]]
        t = T[:3, 3]
        moved = p_t[known] - p_s[known] @ T[:3, :3].T  # scale * t, where poses and matches are right
        if len(moved) < 20 or t @ t == 0:
            continue
        along = moved @ t / (t @ t)
        scale = float(np.median(along))
        far = scale * np.linalg.norm(t) > _LEAST_STEP * np.median(p_t[known, 2])
        agrees = np.linalg.norm(moved - scale * t, axis=1) < 0.5 * abs(scale) * np.linalg.norm(t)
        if scale > 0 and far and agrees.mean() > 0.5:
            return scale
    return None
