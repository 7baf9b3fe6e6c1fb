"""A tracker that takes given poses instead of estimating them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from ..core.errors import TrackingError
from ..core.transforms import invert, nearest_rigid
from ..core.types import Frame
from .base import LEAST_COVERED, Tracked, Tracker
from .overlap import DepthView, measure_mutual_overlap, sample_points
from .records import Records

_FARTHEST = 2000.0
"""Largest distance from the world's origin, meters: beyond it, float32 positions are not exact to a tenth of a
millimeter."""

_OVERLAP_STEP = 16  # pixels between sampled points for the overlap


class GivenTracker(Tracker):
    """Uses (N, 4, 4) given poses of a capture's frames unchanged. A frame with a NaN pose is lost. A frame that shares
    too little with its keyframe becomes a keyframe."""

    def __init__(self, T_world_cam: NDArray[np.float64], keyframe_overlap: float):
        super().__init__()
        self.T_world_cam = T_world_cam
        self.keyframe_overlap = keyframe_overlap
        self._keyframe: DepthView | None = None

    def poses_ahead(self) -> NDArray[np.float64]:
        return self.T_world_cam

    def track(self, frame: Frame) -> Tracked:
        given = self.T_world_cam[frame.index]
        if not np.isfinite(given).all():
            self.records.add_lost(frame.index)
            return Tracked("lost", None, 0.0)
        T_world_cam = nearest_rigid(given)  # files round poses to a few digits
        if np.abs(T_world_cam[:3, 3]).max() > _FARTHEST:
            raise TrackingError(
                f"The pose of frame {frame.index} lies more than {_FARTHEST:g} m from the origin, where positions lose "
                "millimeter accuracy: subtract a common offset from all poses."
            )
        view = self._view(frame)
        nothing_seen = np.count_nonzero(frame.depth_m) < LEAST_COVERED * frame.depth_m.size
        if nothing_seen and self._keyframe is None:
            self.records.add_lost(frame.index)
            return Tracked("lost", None, 0.0)
        if self._keyframe is not None:
            T_keyframe_cam = invert(self.records.T_world_keyframe[-1]) @ T_world_cam
            shared = measure_mutual_overlap(view, self._keyframe, T_keyframe_cam)
            if nothing_seen or shared >= self.keyframe_overlap:
                row = len(self.records.keyframe_index) - 1
                self.records.add_tracked(frame.index, row, T_keyframe_cam, 1.0)
                return Tracked("tracked", T_world_cam, 1.0)
        self._keyframe = view
        self.records.add_keyframe(frame.index, T_world_cam, 1.0)
        return Tracked("keyframe", T_world_cam, 1.0)

    def optimize(self) -> None:
        """Given poses stay as they are."""

    def restore(self, state: dict[str, NDArray[np.generic]], read: Callable[[int], Frame]) -> None:
        self.records = Records.from_arrays(state)
        keyframes = self.records.keyframe_index
        self._keyframe = self._view(read(keyframes[-1])) if keyframes else None

    def _view(self, frame: Frame) -> DepthView:
        return DepthView(
            frame.depth_m, frame.intrinsics, sample_points(frame.depth_m, frame.intrinsics, step=_OVERLAP_STEP)
        )
