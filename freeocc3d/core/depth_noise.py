"""Standard deviation of a pixel's depth: the one that the frame states, or else that of its sensor
(``depth_sensors``)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .compiling import njit
from .types import Frame

MAD_TO_SIGMA = 1.4826
"""Standard deviation of a Gaussian over the median of its absolute value, 1 / Phi^-1(3/4)."""


def take_sigma(frame: Frame) -> NDArray[np.float32]:
    """What ``look_up_sigma`` needs of a frame: its (H, W) ``depth_sigma_m``, or the (1, 3) coefficients of its
    sensor."""
    return frame.sensor.coefficients if frame.depth_sigma_m is None else frame.depth_sigma_m


@njit(cache=True, nogil=True, inline="always")
def look_up_sigma(sigma_m: NDArray[np.float32], row: int, column: int, depth: float) -> float:
    """Standard deviation of a pixel's depth, meters."""
    if len(sigma_m) > 1:
        return np.float64(sigma_m[row, column])
    past = depth - np.float64(sigma_m[0, 2])
    return np.float64(sigma_m[0, 0]) + np.float64(sigma_m[0, 1]) * past * past


def compute_sigma_image(frame: Frame) -> NDArray[np.float32]:
    """(H, W) standard deviations, meters: ``look_up_sigma`` for all pixels, in NumPy."""
    if frame.depth_sigma_m is not None:
        return frame.depth_sigma_m
    return frame.sensor.compute_sigma(frame.depth_m)
