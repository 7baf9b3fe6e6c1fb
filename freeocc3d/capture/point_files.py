"""Reads the point cloud of a capture or trajectory: PLY, PCD or XYZ."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..core.errors import CaptureError, FreeOccError
from ..core.ply_files import read_ply_header


def read_points(path: Path) -> NDArray[np.float64]:
    """Read (P, 3) finite points, in the file's unit. Raises CaptureError: no such file, no points, or damaged."""
    import open3d as o3d

    if not path.is_file():
        raise CaptureError(f"There is no point cloud {path}: check the path.")
    if path.suffix.lower() == ".ply":
        try:
            read_ply_header(path)
        except FreeOccError as error:
            raise CaptureError(str(error)) from error
    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        cloud = o3d.io.read_point_cloud(str(path), remove_nan_points=True, remove_infinite_points=True)
    if not len(cloud.points):
        raise CaptureError(f"{path} holds no points, or is not a readable point cloud (PLY, PCD or XYZ).")
    return np.asarray(cloud.points, np.float64).reshape(-1, 3)
