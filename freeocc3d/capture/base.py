"""The contract of a capture: a folder of frames, or a video, of which frames are decoded one at a time.

A reader is one file of this folder with a class ``Reader(Capture)``. It finds its files and intrinsics when it is
constructed (cheaply: nothing is decoded), and decodes frame i when asked. Everything that is peculiar to a format
(units, axes, file names, invalid values) ends here: what leaves a reader follows the conventions of ``types``.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from pathlib import Path
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from ..core.types import Frame
from ..core.warnings import Notice
from ..settings.stages import CaptureOptions as Options

NOMINAL_DEPTH = 2.0
"""The median depth that scans of unknown scale are given, as rooms have it in meters: voxels and tolerances, which are
in meters, are then of a sensible size beside the scene."""


class Capture(ABC):
    """A captured scan of N frames. Constructing a reader raises CaptureError for a folder that it cannot read."""

    format: ClassVar[str]
    """The reader's name, the same as its file's."""
    layout: ClassVar[str]
    """What ``recognizes`` looks for, in words, for the message about an unrecognized folder."""

    general: ClassVar[bool] = False
    """Whether other formats' folders may look like this one's, too, so that they are looked for first."""

    path: Path
    timestamps: NDArray[np.float64]
    """(N,) seconds, ascending; 0, 1, 2, … where the format has none."""
    has_depth: bool = True
    """Whether frames come with depth; where not, all of ``Frame.depth_m`` is 0."""
    intrinsics_known: bool = True
    """Whether files or the user say what the camera is; where not, ``Frame.intrinsics`` is a usual guess."""
    focal_stated: bool = True
    """Whether at least the focal length is stated, if roughly, as EXIF does; true where the intrinsics are known."""
    metric_poses: bool = True
    """Whether ``pose`` is in meters."""
    warnings: tuple[Notice, ...] = ()
    """What the user should know of what was found, such as files that are left out."""
    classes: tuple[str, ...] = ()
    """Names of the class images' values, index 0 = nothing; empty where the capture has no class images."""

    def __init__(self, path: Path, options: Options):
        self.path = path
        self.options = options

    @classmethod
    @abstractmethod
    def recognizes(cls, path: Path) -> bool:
        """Whether the folder ``path`` has this format's layout (cheap: looks at names only)."""

    def __len__(self) -> int:
        return len(self.timestamps)

    @abstractmethod
    def __getitem__(self, index: int) -> Frame:
        """Decode frame ``index``. Thread-safe. Raises FrameError if one of its files is missing or broken."""

    def raw_depth(self, index: int) -> tuple[NDArray[np.uint16], float] | None:
        """(H, W) depth as stored (0 = no measurement) and its units per meter, or None where depth is not stored as
        integers. Read by ``check_depth_scale`` alone. Raises FrameError."""
        return None

    def name(self, index: int) -> str:
        """File name of the frame's color image, by which other systems' poses may know it; "" where there is none."""
        return ""

    def turned(self, index: int) -> int:
        """Quarter turns, counter-clockwise, by which the frame's image is turned from how the camera was held: images
        of a scan have one size. All else (poses, pixels, pictures) is of the image as it is turned."""
        return 0

    def pose(self, index: int) -> NDArray[np.float64] | None:
        """(4, 4) T_world_cam that the capture states for the frame, or None. Read by the ``known`` tracker and by
        evaluation alone."""
        return None

    def labels(self, index: int) -> NDArray[np.uint8] | None:
        """(H, W) class image of the frame (values index ``classes``, 0 = nothing), or None. Read by the ``labels``
        encoder and by evaluation alone."""
        return None
