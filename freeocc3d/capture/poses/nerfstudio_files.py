"""Reads nerfstudio's transforms.json: images with poses, lenses and depth. Instant-ngp and NeRFCapture write it, too.

Sources: nerfstudio's "Data conventions"; instant-ngp's nerfcapture2nerf.py (depth_path, integer_depth_scale).
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from ..cameras.camera_files import Number, PositiveNumber, read_json

FileName = Annotated[str, Meta(min_length=1, max_length=4096)]
"""The path of a file, relative to the document."""

_Side = Annotated[float, Meta(ge=0, le=1e6)]
_Row = tuple[Number, Number, Number, Number]


class StatedUnit(msgspec.Struct, kw_only=True):
    """What a frame, or the file for all frames, states about its depth; None or no positive number = nothing. Meters
    per unit: depth_unit_scale_factor of any depth, integer_depth_scale of integers."""

    depth_unit_scale_factor: Number | None = None
    integer_depth_scale: Number | None = None

    def units_per_meter(self, floats: bool) -> float | None:
        """Of depth that is stored as floats, or as integers; None = not stated."""
        for meters in (self.depth_unit_scale_factor, None if floats else self.integer_depth_scale):
            if meters is not None and meters > 0:
                return 1.0 / meters
        return None


class StatedLens(StatedUnit, kw_only=True):
    """What a frame, or the file for all frames, states about the camera; None = nothing. Pixels and radians."""

    camera_model: str | None = None
    is_fisheye: bool | None = None
    w: _Side | None = None
    h: _Side | None = None
    fl_x: Number | None = None
    fl_y: Number | None = None
    camera_angle_x: PositiveNumber | None = None
    cx: Number | None = None
    cy: Number | None = None
    k1: Number | None = None
    k2: Number | None = None
    k3: Number | None = None
    k4: Number | None = None
    p1: Number | None = None
    p2: Number | None = None

    def stated(self) -> dict[str, Any]:
        """The values that are stated, by name."""
        names = StatedLens.__struct_fields__
        return {name: value for name in names if (value := getattr(self, name)) is not None}


class PosedFrame(StatedLens, kw_only=True):
    """One image. transform_matrix: camera to world, of a camera that looks along -z with y up."""

    file_path: FileName
    transform_matrix: tuple[_Row, _Row, _Row, _Row]
    depth_file_path: FileName | None = None
    depth_path: FileName | None = None

    @property
    def depth_name(self) -> str | None:
        """The file of the depth, under whichever name it is stated."""
        return self.depth_file_path or self.depth_path


class Transforms(StatedLens, kw_only=True):
    """The content of transforms.json."""

    frames: Annotated[list[PosedFrame], Meta(max_length=1_000_000)]
    ply_file_path: str | None = None

    def poses(self) -> NDArray[np.float64]:
        """(M, 4, 4) T_world_cam of the frames, in OpenCV axes."""
        T = np.array([frame.transform_matrix for frame in self.frames], np.float64).reshape(-1, 4, 4)
        T[:, :, 1:3] *= -1
        return T


def read_transforms(path: Path) -> Transforms:
    """Read the file. Raises CaptureError with the names of the file and the field."""
    return read_json(path, Transforms)
