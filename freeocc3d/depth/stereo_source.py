"""Multi-view stereo as a depth source, for color images with known poses."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from ..capture.base import Capture
from ..core.errors import TrackingError
from ..core.progress import Progress
from ..core.types import Frame
from ..tracking.base import PosedPoints, Tracker
from .base import DepthSource
from .multi_view_stereo import Options, StereoDepth
from .sparse_points import triangulate

_SUREST_M = 5e-4  # a standard deviation of 0 would have infinite weight


class StereoSource(DepthSource):
    """Estimates depth by multi-view stereo, from poses that the tracker knows in advance."""

    offline = True

    def __init__(self, capture: Capture, options: Options):
        self._capture, self._options = capture, options
        self._depth: StereoDepth | None = None

    def prepare(self, tracker: Tracker, folder: Path, frames: range, progress: Progress) -> None:
        self._depth = StereoDepth(folder / "depth", self._options)
        scan = self._posed_points(tracker, frames, progress)
        self._depth.compute(self._capture, scan, frames, progress, tracker.prepare_frame)

    def complete(self, frame: Frame) -> Frame:
        assert self._depth is not None, "prepare comes first"
        found = self._depth.depth(frame.index)
        if found is None:
            return frame
        return replace(frame, depth_m=found[0], depth_sigma_m=np.maximum(found[1], np.float32(_SUREST_M)))

    def _posed_points(self, tracker: Tracker, frames: range, progress: Progress) -> PosedPoints:
        """The tracker's points, or points triangulated from its poses."""
        if (found := tracker.posed_points()) is not None:
            return found
        T_world_cam = tracker.poses_ahead()
        if T_world_cam is None:
            raise TrackingError(
                f"{self._capture.path} has no depth, and this tracker estimates poses frame by frame, but stereo needs "
                "all poses first: leave tracking.backend at auto, or give them (known, file)."
            )
        return triangulate(self._capture, T_world_cam, frames, progress)
