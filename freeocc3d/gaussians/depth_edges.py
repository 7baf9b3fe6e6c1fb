"""Finds pixels at depth edges, where a sensor reports depths that belong to neither side."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..core.compiling import njit


@njit(cache=True, nogil=True)
def is_at_edge(depth_m: NDArray[np.float32], row: int, column: int, edge: float) -> bool:
    """Whether the depth of one of the pixel's four neighbors differs by more than ``edge`` times the nearer of the
    two."""
    depth = depth_m[row, column]
    for i, j in ((row - 1, column), (row + 1, column), (row, column - 1), (row, column + 1)):
        if i < 0 or j < 0 or i >= depth_m.shape[0] or j >= depth_m.shape[1]:
            continue
        other = depth_m[i, j]
        if other > 0 and abs(depth - other) > edge * min(depth, other):
            return True
    return False


def mask_away_from_edges(depth_m: NDArray[np.float32], edge: float) -> NDArray[np.bool_]:
    """(H, W) the pixels with a depth for which ``is_at_edge`` is false, in plain NumPy."""
    good = depth_m > 0
    for axis in (0, 1):
        near, far = np.take(depth_m, range(depth_m.shape[axis] - 1), axis), np.delete(depth_m, 0, axis)
        jump = (np.abs(near - far) > edge * np.minimum(near, far)) & (near > 0) & (far > 0)
        pad = [(0, 0), (0, 0)]
        pad[axis] = (1, 1)
        padded = np.pad(jump, pad)
        good &= ~np.take(padded, range(depth_m.shape[axis]), axis) & ~np.delete(padded, 0, axis)
    return good
