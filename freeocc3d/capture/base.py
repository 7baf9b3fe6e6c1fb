"""The contract of a capture: a folder of frames, or a video, that decodes one frame at a time.

A reader is one file of ``readers/`` with a class ``Reader(Capture)``. Its constructor finds the files and intrinsics
and decodes nothing, so it is cheap. ``reader[i]`` decodes frame i. A reader hides everything that is specific to its
format (units, axes, file names, invalid values): its output follows the conventions of ``core.types``.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from ..core.types import Frame
from ..core.warnings import Notice
from ..settings.stages import CaptureOptions as Options

NOMINAL_DEPTH = 2.0
"""Median depth, meters, to which scans of unknown scale are normalized. It is typical of rooms, so voxel sizes and
tolerances, which are in meters, fit the scene."""


class Capture(ABC):
    """A captured scan of N frames. The constructor raises CaptureError for a folder that the reader cannot read."""

    format: ClassVar[str]
    """The reader's name, equal to the name of its file."""
    layout: ClassVar[str]
    """What ``recognizes`` looks for, in words."""

    parts: ClassVar[tuple[str, ...]] = ()
    """Names, with wildcards, that such a folder holds; " or " divides alternatives. The message about an unknown folder
    says which are missing."""

    general: ClassVar[bool] = False
    """Whether folders of other formats may match this layout too; the other formats are then tried first."""

    reads_files: ClassVar[bool] = False
    """Whether a file may be a capture of this format; most formats are folders."""
    states_poses: ClassVar[bool] = False
    """Whether captures of this format are reconstructions, whose poses are meant to be used if there is no depth."""

    path: Path
    timestamps: NDArray[np.float64]
    """(N,) seconds, ascending; 0, 1, 2, … if the format has no times."""
    has_depth: bool = True
    """Whether frames have depth; if not, ``Frame.depth_m`` is 0 everywhere."""
    intrinsics_known: bool = True
    """Whether the files or the user state the intrinsics; if not, ``Frame.intrinsics`` is a guess."""
    focal_stated: bool = True
    """Whether the focal length is stated at least roughly, as in EXIF; true if the intrinsics are known."""
    metric_poses: bool = True
    """Whether ``pose`` is in meters."""
    warnings: tuple[Notice, ...] = ()
    """Warnings about the files, such as images that are left out."""
    classes: tuple[str, ...] = ()
    """Class names of the values in the class images, index 0 = nothing; empty if there are no class images."""

    def __init__(self, path: Path, options: Options):
        self.path = path
        self.options = options

    @classmethod
    @abstractmethod
    def recognizes(cls, path: Path) -> bool:
        """Whether the folder ``path``, or the file with ``reads_files``, has this format's layout. Cheap: looks at
        names and at the head of a file."""

    def __len__(self) -> int:
        return len(self.timestamps)

    @abstractmethod
    def __getitem__(self, index: int) -> Frame:
        """Decode frame ``index``. Thread-safe. Raises FrameError if one of its files is missing or broken."""

    def raw_depth(self, index: int) -> tuple[NDArray[Any], float] | None:
        """(H, W) depth as stored (0 = no measurement) and its units per meter; None if depth is not stored as integers.
        Only ``depth_units`` reads it. Raises FrameError."""
        return None

    def name(self, index: int) -> str:
        """File name of the frame's color image, "" if it has none. Pose files of other systems may refer to it."""
        return ""

    def files(self, index: int) -> tuple[Path, ...]:
        """The image files of the frame; empty if it has none of its own. Only ``file_heads`` looks at them."""
        return ()

    def turned(self, index: int) -> int:
        """Counter-clockwise quarter turns of the frame's image, relative to how the camera was held. The turns give all
        images of a scan one size. Poses, pixels and pictures refer to the turned image."""
        return 0

    def pose(self, index: int) -> NDArray[np.float64] | None:
        """(4, 4) T_world_cam that the capture states for the frame, or None. Only the ``known`` tracker and evaluation
        read it."""
        return None

    def labels(self, index: int) -> NDArray[np.uint8] | None:
        """(H, W) class image of the frame (values index ``classes``, 0 = nothing), or None. Only the ``labels`` encoder
        and evaluation read it."""
        return None
