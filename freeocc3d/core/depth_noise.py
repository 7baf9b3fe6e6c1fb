"""Standard deviation of a pixel's depth: the one that the frame states, or else that of a structured-light sensor,

    sigma(z) = a + b (z - z_0)^2.

Source: C. V. Nguyen, S. Izadi, D. Lovell, Modeling Kinect Sensor Noise for Improved 3D Reconstruction and Tracking,
3DIMPVT 2012, axial noise.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .compiling import njit
from .types import Frame

AXIAL_NOISE = (0.0012, 0.0019, 0.4)
"""(a, b, z_0) in meters, 1 / meters, meters, as measured in the source."""

NOT_STATED = np.zeros((0, 0), np.float32)
"""Stands for a missing image of standard deviations: those of the sensor model apply."""

MAD_TO_SIGMA = 1.4826
"""Standard deviation of a Gaussian over the median of its absolute value, 1 / Phi^-1(3/4)."""

_A, _B, _NEAREST = AXIAL_NOISE


def compute_sensor_sigma(depth_m: NDArray[np.floating]) -> NDArray[np.float32]:
    """Standard deviations, meters, of a sensor's depths, meters, of any shape."""
    return np.asarray(_A + _B * (depth_m - _NEAREST) ** 2, np.float32)


def take_stated_sigma(frame: Frame) -> NDArray[np.float32]:
    """The frame's ``depth_sigma_m`` for ``look_up_sigma``, or ``NOT_STATED`` if it has none."""
    return NOT_STATED if frame.depth_sigma_m is None else frame.depth_sigma_m


@njit(cache=True, nogil=True, inline="always")
def look_up_sigma(stated_m: NDArray[np.float32], row: int, column: int, depth: float) -> float:
    """Standard deviation of a pixel's depth, meters."""
    if len(stated_m):
        return np.float64(stated_m[row, column])
    return _A + _B * (depth - _NEAREST) ** 2


def compute_sigma_image(frame: Frame) -> NDArray[np.float32]:
    """(H, W) standard deviations, meters: ``look_up_sigma`` for all pixels, in NumPy."""
    return compute_sensor_sigma(frame.depth_m) if frame.depth_sigma_m is None else frame.depth_sigma_m
