"""Matches local features of two images: mutual nearest neighbors that are clearly nearer than the second nearest."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...core.compiling import njit

_FARTHEST = 0.7  # largest angle between descriptors of one point, radians


def match_descriptors(a: NDArray[np.float32], b: NDArray[np.float32], ratio: float) -> NDArray[np.uint32]:
    """(M, 2) matching rows of (N, D) and (K, D) unit descriptors.

    ratio: largest ratio of the angles to the nearest and the second nearest, in both directions; 1 = no such test.
    """
    if len(a) < 2 or len(b) < 2:
        return np.zeros((0, 2), np.uint32)
    to_b, to_a = _nearest(a @ b.T)
    nearest, other = to_b[0].astype(np.int64), to_a[0].astype(np.int64)
    rows = np.flatnonzero(other[nearest] == np.arange(len(a)))
    if ratio < 1:
        rows = rows[_distinct(to_b[1:, rows], ratio) & _distinct(to_a[1:, nearest[rows]], ratio)]
    return np.stack((rows, nearest[rows]), axis=1).astype(np.uint32)


def _distinct(cosines: NDArray[np.float32], ratio: float) -> NDArray[np.bool_]:
    """Whether the first of (2, M) cosines (nearest, second nearest) stands out."""
    first, second = np.arccos(np.clip(cosines, -1, 1))
    return np.asarray((first < ratio * second) & (first < _FARTHEST))


def _nearest_reference(cosines: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """(3, N) for the rows and (3, K) for the columns of (N, K): index of the largest, largest, second largest."""
    found = []
    for table in (cosines, cosines.T):
        order = np.argsort(-table, axis=1, kind="stable")[:, :2]
        values = np.take_along_axis(table, order, axis=1)
        found.append(np.stack((order[:, 0].astype(np.float32), values[:, 0], values[:, 1])))
    return found[0], found[1]


@njit(nogil=True, cache=True)
def _nearest(cosines: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """``_nearest_reference`` in one pass."""
    n, k = cosines.shape
    of_rows, of_columns = np.full((3, n), np.float32(-2)), np.full((3, k), np.float32(-2))
    first, second, place = np.full(k, np.float32(-2)), np.full(k, np.float32(-2)), np.zeros(k, np.float32)
    for i in range(n):
        best, after, at = np.float32(-2), np.float32(-2), 0
        for j in range(k):
            value = cosines[i, j]
            if value > after:
                if value > best:
                    best, after, at = value, best, j
                else:
                    after = value
            if value > second[j]:
                if value > first[j]:
                    second[j] = first[j]
                    first[j] = value
                    place[j] = i
                else:
                    second[j] = value
        of_rows[0, i], of_rows[1, i], of_rows[2, i] = at, best, after
    of_columns[0], of_columns[1], of_columns[2] = place, first, second
    return of_rows, of_columns
