"""Prepares keyframes for tracking, and registers two keyframes by features and dense alignment."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...capture.base import Capture
from ...core.errors import FrameError
from ...core.transforms import transform
from ...core.types import Frame, Intrinsics
from ..overlap import DepthView
from . import dense_alignment, orb_features
from .alignment_views import AlignmentView, prepare_alignment_view
from .dense_residuals import NEAREST_M

_SEARCHED = 0.06  # radians, 3.4 degrees: more than poses are off after loops are closed, 5 cm at 1.5 m and 1 degree
_OVERLAP_STEP = 5  # pixels of an alignment view between sampled points for the overlap


@dataclass(frozen=True)
class KeyframeView:
    """A prepared keyframe. view: for dense alignment.  overlap: sparse sample of its surface.  features: ORB.
    rays: (N, 2) of the features.  points: (N, 3) where the rays meet the surface, z = 0 if they do not.
    camera: of the color image."""

    view: AlignmentView
    overlap: DepthView
    features: orb_features.OrbFeatures
    rays: NDArray[np.float32]
    points: NDArray[np.float32]
    camera: Intrinsics


def sample_surface(view: AlignmentView) -> DepthView:
    """A sparse sample of a view's surface, to measure overlap."""
    sample = view.points[_OVERLAP_STEP // 2 :: _OVERLAP_STEP, _OVERLAP_STEP // 2 :: _OVERLAP_STEP].reshape(-1, 3)
    return DepthView(np.ascontiguousarray(view.points[..., 2]), view.intrinsics, sample[sample[:, 2] > 0])


def prepare_keyframe_view(frame: Frame, view: AlignmentView | None = None) -> KeyframeView:
    """Prepare a frame. view: its alignment view, if it exists already."""
    view = view or prepare_alignment_view(frame)
    found = orb_features.detect_features(frame)
    rays = found.rays(frame.intrinsics)
    return KeyframeView(view, sample_surface(view), found, rays, orb_features.lift_rays(rays, view), frame.intrinsics)


def decode_keyframe_view(capture: Capture, index: int) -> KeyframeView | None:
    """Read and prepare a frame of a capture; None if it cannot be read."""
    try:
        return prepare_keyframe_view(capture[index])
    except FrameError:
        return None


@dataclass(frozen=True)
class FeatureMatches:
    """Matched features with a source depth: points_s (M, 3) in the source, rays_t (M, 2) in the target."""

    points_s: NDArray[np.float32]
    rays_t: NDArray[np.float32]


def match_keyframes(source: KeyframeView, target: KeyframeView) -> FeatureMatches:
    """Match the features of two keyframes by their descriptors."""
    rows = orb_features.match_binary(source.features, target.features)
    points = source.points[rows[:, 0]]
    known = points[:, 2] > 0
    return FeatureMatches(points[known], target.rays[rows[known, 1]])


def match_near(source: KeyframeView, target: KeyframeView, T_target_source: NDArray[np.float64]) -> FeatureMatches:
    """Match the features of two keyframes whose pose is roughly known: only those that it brings near each other."""
    known = np.flatnonzero(source.points[:, 2] > 0)
    moved = transform(T_target_source, source.points[known])
    ahead = moved[:, 2] >= NEAREST_M
    known, moved = known[ahead], moved[ahead]
    rays = moved[:, :2] / moved[:, 2:]
    features = orb_features.OrbFeatures(source.features.pixels[known], source.features.descriptors[known])
    rows = orb_features.match_near(features, rays, target.features, target.rays, _SEARCHED)
    return FeatureMatches(source.points[known[rows[:, 0]]], target.rays[rows[:, 1]])


@dataclass(frozen=True)
class FeatureRegistration:
    """T_target_source (4, 4) from features, the number of its inliers, and the dense alignment that starts from it."""

    by_features: NDArray[np.float64]
    agreeing: int
    aligned: dense_alignment.ViewAlignment


def register_by_features(
    source: KeyframeView, target: KeyframeView, iterations: int = 300
) -> FeatureRegistration | None:
    """Pose from features, refined densely; None if too few features agree. iterations: RANSAC draws at most."""
    pairs = match_keyframes(source, target)
    found = orb_features.estimate_pose(pairs.points_s, pairs.rays_t, 1.0 / target.camera.fx, iterations=iterations)
    if found is None:
        return None
    return FeatureRegistration(found[0], len(found[1]), dense_alignment.align_views(source.view, target.view, found[0]))
