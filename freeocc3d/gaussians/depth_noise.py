"""How uncertain a pixel's depth is: as its image says, or as a sensor's usually is."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ..core.transforms import AXIAL_NOISE, depth_sigma
from ..core.types import Frame

_A, _B, _NEAREST = AXIAL_NOISE
_NOT_SAID = np.zeros((0, 0), np.float32)


def said(frame: Frame) -> NDArray[np.float32]:
    """The frame's ``depth_sigma_m`` for ``sigma_at``: (0, 0) where there is none."""
    return _NOT_SAID if frame.depth_sigma_m is None else frame.depth_sigma_m


@njit(cache=True, nogil=True)
def sigma_at(said_m: NDArray[np.float32], row: int, column: int, depth: float) -> float:
    """Standard deviation of a pixel's depth, metres."""
    if len(said_m):
        return np.float64(said_m[row, column])
    return _A + _B * (depth - _NEAREST) ** 2


def sigma_image(frame: Frame) -> NDArray[np.float32]:
    """(H, W) standard deviations, metres, in plain NumPy."""
    return depth_sigma(frame.depth_m) if frame.depth_sigma_m is None else frame.depth_sigma_m
