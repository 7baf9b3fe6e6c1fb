"""INPUT: captures. ``open_capture`` finds the reader of a folder; ``read_ahead`` decodes frames on a second thread."""

from .base import Capture, Options
from .opening import open_capture, select_frames
from .read_ahead import read_ahead
from .trajectory_files import PoseFile, associate, read_trajectory

__all__ = [
    "Capture",
    "Options",
    "PoseFile",
    "associate",
    "open_capture",
    "read_ahead",
    "read_trajectory",
    "select_frames",
]
