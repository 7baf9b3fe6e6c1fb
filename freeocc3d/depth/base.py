"""The contract of a depth source: how far the things are that a scan's frames show, where no sensor measured it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from pathlib import Path
from typing import ClassVar

from ..core.progress import Progress
from ..core.types import Frame
from ..tracking.base import Tracker


class DepthSource(ABC):
    """Gives frames the depth that they lack."""

    offline: ClassVar[bool] = False
    """Whether ``prepare`` works through the whole scan before the first frame is completed."""

    def prepare(self, tracker: Tracker, folder: Path, frames: range, progress: Progress) -> None:  # noqa: B027, most have nothing to do
        """What is done for the whole scan before its first frame is completed; called if ``offline``, after
        ``tracker.prepare``.

        tracker: the one whose poses are used, and which prepares the frames.  folder: takes whatever lets an
        interrupted run go on; gone when the map is there.  frames: those of the capture that are used.
        Raises TrackingError for a scan whose depth cannot be found.
        """

    @abstractmethod
    def complete(self, frame: Frame) -> Frame:
        """The frame with its depth; ``frame`` is what ``tracker.prepare_frame`` gave."""


class MeasuredDepth(DepthSource):
    """What the frames hold already, from the capture's sensor or from their tracker."""

    def complete(self, frame: Frame) -> Frame:
        return frame
