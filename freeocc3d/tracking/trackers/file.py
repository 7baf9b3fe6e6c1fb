"""Reads another system's poses from a file: TUM and other tables, KITTI, .log, COLMAP, nerfstudio, 7-Scenes."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import Annotated, ClassVar

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from ...capture import read_trajectory, select_frames
from ...capture.base import Capture
from ...capture.point_files import read_points
from ...core.errors import ConfigError, TrackingError
from ...core.regular_files import user_path
from ...core.sampling import spread_evenly
from ...core.transforms import invert, project, transform
from ...core.types import Frame
from ...settings.option_types import FilePath
from ..base import KeyframeOptions
from ..given_poses import GivenTracker
from ..rgbd import orb_features
from ..rgbd.keyframe_registration import decode_keyframe_view

REQUIRES: tuple[str, ...] = ("open3d",)

_PAIRS, _LEAST_PAIRS = 24, 6  # pairs of frames to measure the scale with, and the smallest number that gives one
_GAPS = (12, 6, 3, 1)  # frames between the two of a pair, in the order to try them
_LEAST_MATCHES = 20  # smallest number of a pair's matches with depth on both sides
_AGREES, _AGREEING = 0.5, 0.5  # largest error of a match, relative to a pair's motion; smallest share of such matches
_LEAST_STEP = 0.05  # of the depth: frames that are nearer to each other give no reliable scale
_CELL = 8  # pixels: within a cell, a cloud's points hide those behind them
_BEHIND = 0.05  # of the depth: how far behind a point must lie to be hidden


class Options(KeyframeOptions, frozen=True):
    """The trajectory file, how to match its poses to frames, its scale, and its point cloud."""

    path: str = ""
    """The trajectory: a file, or a folder of 7-Scenes poses or a COLMAP model; may be relative to the capture."""
    max_time_difference: Annotated[float, Meta(gt=0, le=3600)] = 0.02
    """Largest time difference of a pose and its frame, seconds, for files with times."""
    scale: Annotated[float, Meta(ge=1e-6, le=1e6)] | None = 1.0
    """Meters per unit of the file. null (for monocular systems) = estimate it from the capture's depth; without depth,
    use capture.scale, else it is unknown."""
    points: FilePath | None = None
    """Point cloud (PLY, PCD, XYZ) in the file's world, which gives depth to frames where they have none."""


def load(options: Options, capture: Capture) -> FileTracker:
    """Load the tracker for the file ``options.path``.

    Raises ConfigError (no path), CaptureError (the file is unreadable or has no pose for this capture), TrackingError
    (the scale is asked for and cannot be estimated).
    """
    if not options.path:
        raise ConfigError("tracking.backend=file needs a trajectory: set tracking.file.path.")
    found = read_trajectory(_beside(options.path, capture))
    T_world_cam = found.of_frames(capture, options.max_time_difference)
    points = None if options.points is None else read_points(_beside(options.points, capture)).astype(np.float32)
    scale = _scale(T_world_cam, capture, options)
    T_world_cam[:, :3, 3] *= scale
    scaled = None if points is None else points * np.float32(scale)
    tracker = FileTracker(T_world_cam, options.keyframe_overlap, scaled)
    missing = found.report_missing(T_world_cam, select_frames(capture), capture.path)
    tracker.warnings = () if missing is None else (missing,)
    tracker.metric = capture.has_depth or options.scale is not None or capture.options.scale is not None
    return tracker


class FileTracker(GivenTracker):
    """Takes the poses of a file. The world frame is the file's, in meters. A point cloud, (P, 3) world, gives depth to
    pixels that have none."""

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
    """Project (P, 3) camera-frame points to an (H, W) depth map, meters; the nearest point of a pixel wins, 0 = none. A
    cloud has gaps, so a point far behind others in the same cell of pixels counts as hidden."""
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
    """The path as given or, if it does not exist, the path in the capture's folder or the folder of the video."""
    given = user_path(path)
    inside = (capture.path.parent if capture.path.is_file() else capture.path) / given
    return inside if not os.path.exists(given) and os.path.exists(inside) else given


def _scale(T_world_cam: NDArray[np.float64], capture: Capture, options: Options) -> float:
    """Meters per unit: from the options, else from depth; 1 if unknown."""
    if not capture.has_depth:
        return capture.options.scale or options.scale or 1.0
    if options.scale is not None:
        return options.scale
    measured = estimate_depth_scale(T_world_cam, capture)
    if measured is None:
        raise TrackingError(
            f"The scale of {options.path} cannot be estimated from the depth of {capture.path}: too few frames with a "
            "pose and depth overlap. Give tracking.file.scale."
        )
    return measured


def estimate_depth_scale(T_world_cam: NDArray[np.float64], capture: Capture) -> float | None:
    """Estimate meters per unit of (N, 4, 4) poses from the capture's depth; None with too few matches.

    For matched features of two frames, back-projected to p_s and p_t, p_t = R p_s + scale t. Each match gives a scale
    along t. The result is the median over pairs of the median within each pair.
    """
    posed = np.flatnonzero(np.isfinite(T_world_cam).all(axis=(1, 2)))
    scales = []
    for start in spread_evenly(len(posed) - 1, _PAIRS):
        if len(posed) < 2:
            break
        found = _pair_scale(T_world_cam, capture, posed[start:])
        if found is not None:
            scales.append(found)
    return float(np.median(scales)) if len(scales) >= _LEAST_PAIRS else None


def _pair_scale(T_world_cam: NDArray[np.float64], capture: Capture, frames: NDArray[np.int64]) -> float | None:
    target = decode_keyframe_view(capture, int(frames[0]))
    for gap in _GAPS:
        source = decode_keyframe_view(capture, int(frames[gap])) if target is not None and gap < len(frames) else None
        if target is None or source is None:
            continue
        rows = orb_features.match_binary(source.features, target.features)
        p_s, p_t = source.points[rows[:, 0]].astype(np.float64), target.points[rows[:, 1]].astype(np.float64)
        known = (p_s[:, 2] > 0) & (p_t[:, 2] > 0)
        T = invert(T_world_cam[frames[0]]) @ T_world_cam[frames[gap]]
        t = T[:3, 3]
        moved = p_t[known] - p_s[known] @ T[:3, :3].T  # scale * t, where poses and matches are right
        if len(moved) < _LEAST_MATCHES or t @ t == 0:
            continue
        along = moved @ t / (t @ t)
        scale = float(np.median(along))
        far = scale * np.linalg.norm(t) > _LEAST_STEP * np.median(p_t[known, 2])
        agrees = np.linalg.norm(moved - scale * t, axis=1) < _AGREES * abs(scale) * np.linalg.norm(t)
        if scale > 0 and far and agrees.mean() > _AGREEING:
            return scale
    return None
