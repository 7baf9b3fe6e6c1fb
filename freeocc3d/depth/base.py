"""The contract of a depth source, which gives depth maps to frames without sensor depth."""

from __future__ import annotations

from abc import ABC, abstractmethod
from pathlib import Path
from typing import ClassVar

from ..core.progress import Progress
from ..core.types import Frame
from ..tracking.base import Tracker


class DepthSource(ABC):
    """Adds depth to frames that lack it."""

    offline: ClassVar[bool] = False
    """Whether ``prepare`` processes the whole scan before ``complete`` gets the first frame."""

    def prepare(self, tracker: Tracker, folder: Path, frames: range, progress: Progress) -> None:  # noqa: B027, most have nothing to do
        """Process the whole scan before the first frame is completed; called if ``offline``, after ``tracker.prepare``.

        tracker: gives the poses and prepares the frames.  folder: keeps what an interrupted run needs to continue; it
        is deleted when the map is finished.  frames: the selected frames of the capture.
        Raises TrackingError if no depth can be estimated for the scan.
        """

    @abstractmethod
    def complete(self, frame: Frame) -> Frame:
        """The frame with its depth. frame: a frame from ``tracker.prepare_frame``."""


class MeasuredDepth(DepthSource):
    """Keeps the depth that the frames have, from the capture's sensor or from the tracker."""

    def complete(self, frame: Frame) -> Frame:
        return frame
