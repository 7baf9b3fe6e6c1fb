"""What the tracker keeps of a keyframe, and how two of them are registered."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...capture.base import Capture
from ...core.errors import FrameError
from ...core.types import Frame, Intrinsics
from ..overlap import DepthView
from . import dense_alignment, orb_features
from .alignment_views import AlignmentView, prepare_alignment_view

_OVERLAP_STEP = 5


@dataclass(frozen=True)
class KeyframeView:
    """view: for dense alignment.  overlap: its surface, sparsely.  features: ORB.  rays: (N, 2) of the features.
    points: (N, 3) where they meet the surface, z = 0 where there is none.  camera: of the color image."""

    view: AlignmentView
    overlap: DepthView
    features: orb_features.OrbFeatures
    rays: NDArray[np.float32]
    points: NDArray[np.float32]
    camera: Intrinsics


def sample_surface(view: AlignmentView) -> DepthView:
    """A sparse sample of a view's surface, to measure overlap with."""
    sample = view.points[_OVERLAP_STEP // 2 :: _OVERLAP_STEP, _OVERLAP_STEP // 2 :: _OVERLAP_STEP].reshape(-1, 3)
    return DepthView(view.points[..., 2], view.intrinsics, sample[sample[:, 2] > 0])


def prepare_keyframe_view(frame: Frame, view: AlignmentView | None = None) -> KeyframeView:
    """Prepare a frame; ``view`` if it is there already."""
    view = view or prepare_alignment_view(frame)
    found = orb_features.detect_features(frame)
    rays = found.rays(frame.intrinsics)
    return KeyframeView(view, sample_surface(view), found, rays, orb_features.lift_rays(rays, view), frame.intrinsics)


def decode_keyframe_view(capture: Capture, index: int) -> KeyframeView | None:
    """A frame of a capture, prepared; None if it cannot be read."""
    try:
        return prepare_keyframe_view(capture[index])
    except FrameError:
        return None


@dataclass(frozen=True)
class FeatureMatches:
    """Features of a source that match a target's, with a depth: points_s (M, 3), rays_t (M, 2)."""

    points_s: NDArray[np.float32]
    rays_t: NDArray[np.float32]


def match_keyframes(source: KeyframeView, target: KeyframeView) -> FeatureMatches:
    """Match features by their descriptors."""
    rows = orb_features.match_binary(source.features, target.features)
    points = source.points[rows[:, 0]]
    known = points[:, 2] > 0
    return FeatureMatches(points[known], target.rays[rows[known, 1]])


@dataclass(frozen=True)
class FeatureRegistration:
    """T_target_source (4, 4) that features give, how many of them agree on it, and the dense alignment from there."""

    by_features: NDArray[np.float64]
    agreeing: int
    aligned: dense_alignment.ViewAlignment


def register_by_features(
    source: KeyframeView, target: KeyframeView, iterations: int = 300
) -> FeatureRegistration | None:
    """Pose from features, refined densely; None where they do not tell. iterations: draws of RANSAC at most."""
    pairs = match_keyframes(source, target)
    found = orb_features.estimate_pose(pairs.points_s, pairs.rays_t, 1.0 / target.camera.fx, iterations=iterations)
    if found is None:
        return None
    return FeatureRegistration(found[0], len(found[1]), dense_alignment.align_views(source.view, target.view, found[0]))
