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
from .alignment_views import View, view_of

_OVERLAP_STEP = 5


@dataclass(frozen=True)
class KeyframeView:
    """view: for dense alignment.  overlap: its surface, sparsely.  features: ORB.  rays: (N, 2) of the features.
    points: (N, 3) where they meet the surface, z = 0 where there is none.  camera: of the colour image."""

    view: View
    overlap: DepthView
    features: orb_features.Features
    rays: NDArray[np.float32]
    points: NDArray[np.float32]
    camera: Intrinsics


def surface_of(view: View) -> DepthView:
    """A sparse sample of a view's surface, to measure overlap with."""
    sample = view.points[_OVERLAP_STEP // 2 :: _OVERLAP_STEP, _OVERLAP_STEP // 2 :: _OVERLAP_STEP].reshape(-1, 3)
    return DepthView(view.points[..., 2], view.intrinsics, sample[sample[:, 2] > 0])


def keyframe_view(frame: Frame, view: View | None = None) -> KeyframeView:
    """Prepare a frame; ``view`` if it is there already."""
    view = view or view_of(frame)
    found = orb_features.detect(frame)
    rays = found.rays(frame.intrinsics)
    return KeyframeView(view, surface_of(view), found, rays, orb_features.lift(rays, view), frame.intrinsics)


def decoded_view(capture: Capture, index: int) -> KeyframeView | None:
    """A frame of a capture, prepared; None if it cannot be read."""
    try:
        return keyframe_view(capture[index])
    except FrameError:
        return None


@dataclass(frozen=True)
class Matched:
    """Features of a source that match a target's, with a depth: points_s (M, 3), rays_t (M, 2)."""

    points_s: NDArray[np.float32]
    rays_t: NDArray[np.float32]


def matched(source: KeyframeView, target: KeyframeView) -> Matched:
    """Match features by their descriptors."""
    rows = orb_features.match(source.features, target.features)
    points = source.points[rows[:, 0]]
    known = points[:, 2] > 0
    return Matched(points[known], target.rays[rows[known, 1]])


@dataclass(frozen=True)
class Registered:
    """T_target_source (4, 4) that features give, how many of them agree on it, and the dense alignment from there."""

    by_features: NDArray[np.float64]
    agreeing: int
    aligned: dense_alignment.Alignment


def register_by_features(source: KeyframeView, target: KeyframeView, iterations: int = 300) -> Registered | None:
    """Pose from features, refined densely; None where they do not tell. iterations: draws of RANSAC at most."""
    pairs = matched(source, target)
    found = orb_features.pose(pairs.points_s, pairs.rays_t, 1.0 / target.camera.fx, iterations=iterations)
    if found is None:
        return None
    return Registered(found[0], len(found[1]), dense_alignment.align(source.view, target.view, found[0]))
