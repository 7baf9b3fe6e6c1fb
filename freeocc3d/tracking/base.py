"""The contract of a tracker: it takes frames one by one and gives camera poses.

A tracker is one file of ``trackers/`` with ``load(options, capture) -> Tracker``. It also chooses the keyframes. Layers
2–4 use only keyframes, so together they must show the whole scene.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from ..core.progress import Progress
from ..core.types import Frame, Submap, Trajectory
from ..core.warnings import Notice
from ..settings.typed_options import TypedOptions
from .pose_graph import Edge, edges_to_arrays
from .records import Records

Overlap = Annotated[float, Meta(gt=0, le=2)]
LEAST_COVERED = 0.05
"""Smallest share of a frame's pixels with a surface to track."""


class KeyframeOptions(TypedOptions, frozen=True):
    """Which frames become keyframes."""

    keyframe_overlap: Overlap = 0.85
    """A frame becomes a keyframe if it shares less than this part of its keyframe's view."""


@dataclass(frozen=True)
class Tracked:
    """The tracking result of one frame.

    status: "keyframe", "tracked", "relocalised" or "lost".
    T_world_cam: (4, 4) current estimate, None if lost; a later optimization may change it.
    confidence: 0…1.
    """

    status: str
    T_world_cam: NDArray[np.float64] | None
    confidence: float


@dataclass(frozen=True)
class PosedPoints:
    """Poses of a capture's N frames, and sparse points that these frames see.

    T_world_cam: (N, 4, 4) float64, NaN where a frame has no pose.  points: (P, 3) float32 world.
    seen_frame, seen_point: (O,) int32; frame ``seen_frame[o]`` sees point ``seen_point[o]``.
    """

    T_world_cam: NDArray[np.float64]
    points: NDArray[np.float32]
    seen_frame: NDArray[np.int32]
    seen_point: NDArray[np.int32]


class Tracker(ABC):
    """Follows the camera through a capture. Frames come in ascending order; some may be left out."""

    world: ClassVar[str] = "OpenCV camera axes of the first keyframe, meters"
    """The coordinate frame of poses and maps, for the map's manifest."""
    needs_depth: ClassVar[bool] = False
    """Whether the tracker needs a capture with depth."""
    estimates_camera: ClassVar[bool] = False
    """Whether the tracker estimates unknown intrinsics."""
    metric: bool = True
    """Whether poses are in meters; if not, their unit and the scale of the map are unknown."""
    offline: bool = False
    """Whether ``prepare`` processes the whole scan before ``track`` gets the first frame."""
    warnings: tuple[Notice, ...] = ()
    """Warnings of ``load`` and ``prepare`` for the user."""
    brings_depth: bool = False
    """Whether ``prepare_frame`` adds depth, so that a capture without depth needs no other depth source."""

    def __init__(self) -> None:
        self.records = Records()
        self.edges: list[Edge] = []

    def prepare(self, folder: Path, frames: range, progress: Progress) -> None:  # noqa: B027, most have nothing to do
        """Process the whole scan before the first frame is tracked; called if ``offline``.

        folder: keeps what an interrupted run needs to continue; it is deleted when the map is finished.  frames: the
        selected frames of the capture. Raises TrackingError for a scan that cannot be tracked.
        """

    def poses_ahead(self) -> NDArray[np.float64] | None:
        """(N, 4, 4) T_world_cam of the capture's frames, NaN without a pose, if they are known after ``prepare``,
        before the first frame is tracked. None if poses are estimated frame by frame."""
        return None

    def posed_points(self) -> PosedPoints | None:
        """``poses_ahead`` with the sparse points of the same reconstruction; None if there are no points."""
        return None

    def prepare_frame(self, frame: Frame) -> Frame:
        """The frame as the tracker uses it: undistorted, with the depth that the tracker brings. ``track`` takes this
        frame, and keyframes keep it."""
        return frame

    @abstractmethod
    def track(self, frame: Frame) -> Tracked:
        """Track the next frame."""

    @abstractmethod
    def optimize(self) -> None:
        """Make all poses so far consistent with all measurements so far. The world frame is the first keyframe's;
        trackers with given poses keep their own world frame."""

    def release(self) -> None:  # noqa: B027, most keep nothing else
        """Forget what only ``track`` and ``optimize`` need; the run will call neither again."""

    @abstractmethod
    def restore(self, state: dict[str, NDArray[np.generic]], read: Callable[[int], Frame]) -> None:
        """Continue from a saved ``state``, to the same result as without a stop. read: gives a frame of the capture
        as ``track`` got it."""

    def state(self) -> dict[str, NDArray[np.generic]]:
        """Everything needed to continue later, as plain arrays."""
        return {**self.records.to_arrays(), **edges_to_arrays(self.edges)}

    def trajectory(self, timestamps: NDArray[np.float64]) -> Trajectory:
        """Poses of all frames of the capture. Frames that ``track`` never got are "unused"."""
        return self.records.trajectory(timestamps)

    def submaps(self) -> list[Submap]:
        """The connected components of the camera path; the mapped one comes first."""
        return self.records.submaps(self.edges)
