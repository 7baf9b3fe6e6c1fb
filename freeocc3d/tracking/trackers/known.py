"""Uses the capture's own poses. A frame that shares too little with its keyframe becomes a keyframe."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from ...capture.base import Capture
from ...core.errors import TrackingError
from ..base import KeyframeOptions
from ..given_poses import GivenTracker

REQUIRES: tuple[str, ...] = ()


class Options(KeyframeOptions, frozen=True):
    """When a frame becomes a keyframe."""


def load(options: Options, capture: Capture) -> KnownTracker:
    """Load the tracker, which reads ``capture.pose``. Raises TrackingError if the capture has no poses."""
    stated = [capture.pose(index) for index in range(len(capture))]
    if all(pose is None for pose in stated):
        raise TrackingError(f"{capture.path} has no poses: leave tracking.backend at auto, which estimates them.")
    none = np.full((4, 4), np.nan)
    given = np.stack([none if pose is None else pose for pose in stated])
    tracker = KnownTracker(given, options.keyframe_overlap)
    tracker.metric = capture.metric_poses
    return tracker


class KnownTracker(GivenTracker):
    """Takes the capture's poses. The world frame is that of these poses; a frame without a pose is lost."""

    world: ClassVar[str] = "world frame of the capture's poses, meters"
