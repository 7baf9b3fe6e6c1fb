"""INPUT: captures. ``open_capture`` finds the reader of a folder; ``read_ahead`` decodes frames on a second thread.

``readers/`` has one file a format; ``rgbd_frames``, ``frame_files`` and ``posed_images`` are what they share.
``files/`` lists and pairs files by their names, ``images/`` and ``videos/`` decode them, ``cameras/`` knows
calibrations and lenses, ``poses/`` what is stated about poses, ``ros/`` bags, and ``checks/`` compares what a capture
says with what it shows.
"""

from .base import Capture, Options
from .opening import open_capture, select_frames
from .poses.trajectory_files import PoseFile, associate, read_trajectory
from .read_ahead import read_ahead

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
