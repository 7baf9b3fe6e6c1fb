"""The contract of a tracker: frames in, one by one; camera poses out.

A tracker is one file of this folder with ``load(options, capture) -> Tracker``. The frames that it names as keyframes
carry the map: layers 2–4 use only these, so a tracker chooses them such that together they show the whole scene.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from ..core.progress import Progress
from ..core.types import Frame, Submap, Trajectory
from ..core.warnings import Notice
from ..settings.option_types import Positive
from ..settings.typed_options import TypedOptions
from .pose_graph import Edge, edges_to_arrays
from .records import Records


class KeyframeOptions(TypedOptions, frozen=True):
    """Which frames become keyframes."""

    keyframe_overlap: Positive = 0.85
    """A frame that shares less than this of its keyframe's view becomes a keyframe."""


@dataclass(frozen=True)
class Tracked:
    """What became of one frame.

    status: "keyframe", "tracked", "relocalised" or "lost".
    T_world_cam: (4, 4) the current estimate, None if lost; a later optimization may still move it.
    confidence: 0…1.
    """

    status: str
    T_world_cam: NDArray[np.float64] | None
    confidence: float


@dataclass(frozen=True)
class PosedPoints:
    """Poses of a capture's N frames, and sparse points that these frames see.

    T_world_cam: (N, 4, 4) float64, NaN where a frame has none.  points: (P, 3) float32 world.
    seen_frame, seen_point: (O,) int32, point ``seen_point[o]`` is seen in frame ``seen_frame[o]``.
    """

    T_world_cam: NDArray[np.float64]
    points: NDArray[np.float32]
    seen_frame: NDArray[np.int32]
    seen_point: NDArray[np.int32]


class Tracker(ABC):
    """Follows the camera through a capture. Frames must come in ascending order; some may be left out."""

    world: ClassVar[str] = "OpenCV camera axes of the first keyframe, meters"
    """The frame that poses and maps are in, for the map's manifest."""
    needs_depth: ClassVar[bool] = False
    """Whether it cannot work on a capture without depth."""
    estimates_camera: ClassVar[bool] = False
    """Whether it finds out what the camera is where the capture does not know."""
    metric: bool = True
    """Whether its poses are in meters; where not, their unit is unknown, and so is the scale of what is mapped."""
    offline: bool = False
    """Whether ``prepare`` works through the whole scan before the first frame is tracked."""
    warnings: tuple[Notice, ...] = ()
    """What ``prepare`` found that the user should know."""
    brings_depth: bool = False
    """Whether ``prepare_frame`` adds depth, so that a capture without any needs no other depth source."""

    def __init__(self) -> None:
        self.records = Records()
        self.edges: list[Edge] = []

    def prepare(self, folder: Path, frames: range, progress: Progress) -> None:  # noqa: B027, most have nothing to do
        """What is done for the whole scan before its first frame is tracked; called if ``offline``.

        folder: takes whatever lets an interrupted run go on; gone when the map stands.  frames: those of the capture
        that are used. Raises TrackingError for a scan that cannot be tracked.
        """

    def poses_ahead(self) -> NDArray[np.float64] | None:
        """(N, 4, 4) T_world_cam of the capture's frames, NaN where one has none, if they stand before the first frame
        is tracked (after ``prepare``); None where poses are estimated frame by frame."""
        return None

    def posed_points(self) -> PosedPoints | None:
        """``poses_ahead`` with the sparse points that they were found with; None where there are no such points."""
        return None

    def prepare_frame(self, frame: Frame) -> Frame:
        """The frame as the tracker's camera is known to see it: undistorted, with depth that the tracker was given.
        ``track`` takes this one, and keyframes keep it."""
        return frame

    @abstractmethod
    def track(self, frame: Frame) -> Tracked:
        """Take the next frame."""

    @abstractmethod
    def optimize(self) -> None:
        """Make all poses so far consistent with all measurements so far. The world frame is the first keyframe's
        (trackers that are given poses keep theirs)."""

    @abstractmethod
    def restore(self, state: dict[str, NDArray[np.generic]], keyframes: Sequence[Frame]) -> None:
        """Take up a saved ``state``; ``keyframes`` gives the keyframes' images, in order."""

    def state(self) -> dict[str, NDArray[np.generic]]:
        """Everything needed to go on later, as plain arrays."""
        return {**self.records.to_arrays(), **edges_to_arrays(self.edges)}

    def trajectory(self, timestamps: NDArray[np.float64]) -> Trajectory:
        """Poses of all frames of the capture; frames that were never given to ``track`` are "unused"."""
        return self.records.trajectory(timestamps)

    def submaps(self) -> list[Submap]:
        """The pieces of the path that hang together, the one that is mapped first."""
        return self.records.submaps(self.edges)
