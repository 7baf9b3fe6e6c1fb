"""Takes the capture's own poses; a frame that shares too little with its keyframe becomes a keyframe."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from ..capture.base import Capture
from ..errors import TrackingError
from ..geometry import invert, nearest_rigid
from ..registry import require_positive
from ..types import Frame, Trajectory
from .base import Tracked, Tracker
from .overlap import DepthView, mutual_overlap, sample_points
from .records import Records

REQUIRES: tuple[str, ...] = ()

_FARTHEST = 2000.0


@dataclass(frozen=True)
class Options:
    """Keyframes."""

    keyframe_overlap: float = 0.85
    """A frame that shares less than this of its keyframe's view becomes a keyframe."""

    def __post_init__(self) -> None:
        require_positive(self, "keyframe_overlap")


def load(options: Options, capture: Capture) -> KnownTracker:
    """The tracker that reads ``capture.pose``. Raises TrackingError if the capture has no poses at all."""
    if all(capture.pose(i) is None for i in range(len(capture))):
        raise TrackingError(f"{capture.path} brings no poses: use tracking.backend=rgbd, which estimates them.")
    return KnownTracker(options, capture)


class KnownTracker(Tracker):
    """The world frame is that of the capture's poses; a frame without a pose is lost."""

    world: ClassVar[str] = "world frame of the capture's poses, metres"

    def __init__(self, options: Options, capture: Capture):
        self.options = options
        self.capture = capture
        self.records = Records()
        self._keyframe: DepthView | None = None

    def track(self, frame: Frame) -> Tracked:
        given = self.capture.pose(frame.index)
        if given is None:
            self.records.add_lost(frame.index)
            return Tracked("lost", None, 0.0)
        T_world_cam = nearest_rigid(given)  # files state poses to a few digits
        if np.abs(T_world_cam[:3, 3]).max() > _FARTHEST:
            raise TrackingError(
                f"The pose of frame {frame.index} lies more than {_FARTHEST:g} m from the origin, where positions lose "
                "their millimetres: subtract a common offset from the capture's poses."
            )
        view = self._view(frame)
        nothing_seen = np.count_nonzero(frame.depth_m) < 0.05 * frame.depth_m.size
        if nothing_seen and self._keyframe is None:
            self.records.add_lost(frame.index)
            return Tracked("lost", None, 0.0)
        if self._keyframe is not None:
            T_keyframe_cam = invert(self.records.T_world_keyframe[-1]) @ T_world_cam
            shared = mutual_overlap(view, self._keyframe, T_keyframe_cam)
            if nothing_seen or shared >= self.options.keyframe_overlap:
                row = len(self.records.keyframe_index) - 1
                self.records.add_tracked(frame.index, row, T_keyframe_cam, 1.0)
                return Tracked("tracked", T_world_cam, 1.0)
        self._keyframe = view
        self.records.add_keyframe(frame.index, T_world_cam, 1.0)
        return Tracked("keyframe", T_world_cam, 1.0)

    def optimize(self) -> None:
        """Given poses stay as they are."""

    def trajectory(self, timestamps: NDArray[np.float64]) -> Trajectory:
        return self.records.trajectory(timestamps)

    def state(self) -> dict[str, NDArray[np.generic]]:
        return self.records.to_arrays()

    def restore(self, state: dict[str, NDArray[np.generic]], keyframes: Sequence[Frame]) -> None:
        self.records = Records.from_arrays(state)
        self._keyframe = self._view(keyframes[-1]) if keyframes else None

    def _view(self, frame: Frame) -> DepthView:
        return DepthView(frame.depth_m, frame.intrinsics, sample_points(frame.depth_m, frame.intrinsics, step=16))
