"""Where voxels lie in an upright frame: the floor inside a layer of voxels, and walls too where their places allow."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .surface_patches import SurfacePatches

_FACING = np.cos(np.deg2rad(5.0))  # a wall across an axis has its normal within this angle of the axis
_PHASES = 32
"""Number of shifts of the lattice to try along an axis."""
_NEAR_FACE = 0.15
"""Of a voxel: standard deviation of the weight by which a wall near a face between two layers counts. The noise of a
wall at 2 m, averaged over frames, is less than this part of a voxel of 4 cm."""


def find_lattice_origin(upright: SurfacePatches, voxel_size: float) -> NDArray[np.float64]:
    """Returns (3,) the lower corner of voxel (0, 0, 0) in an upright frame, meters, within one voxel of its origin.

    upright: patches in that frame. z = 0 lies a third of a voxel above a face: so it lies a third from a face of the
    halves, the quarters and so on, too. Along x and y, the fewest walls lie near faces between layers. Without walls,
    x = y = 0 is the middle of a voxel.
    """
    origin = np.array((-0.5, -0.5, -1 / 3))
    for axis in (0, 1):
        across = np.abs(upright.normals[:, axis]) > _FACING
        if across.any():
            origin[axis] = _find_phase(upright.points[across, axis] / voxel_size)
    return voxel_size * origin


def _find_phase(places: NDArray[np.float64]) -> float:
    """Returns the place in [-1, 0) of a face, in voxels, for walls at (N,) places, in voxels."""
    phases = np.arange(_PHASES) / _PHASES - 1
    count = np.bincount(np.floor(_PHASES * (places % 1.0)).astype(np.int64) % _PHASES, minlength=_PHASES)
    off = ((phases[:, None] - (np.arange(_PHASES) + 0.5) / _PHASES) + 0.5) % 1.0 - 0.5
    near = np.exp(-0.5 * (off / _NEAR_FACE) ** 2) @ count
    return float(phases[int(np.argmin(near))])
