"""Pairs the times of two streams: each with the nearest of the other."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def pair_nearest(a: NDArray[np.floating], b: NDArray[np.floating], within: float) -> NDArray[np.int64]:
    """(P, 2) rows of (N,) and (M,) ascending times that are each other's nearest, at most ``within`` seconds apart."""
    if not len(a) or not len(b):
        return np.zeros((0, 2), np.int64)
    of_a, of_b = _nearest(a, b), _nearest(b, a)
    rows = np.arange(len(a))
    good = (of_b[of_a] == rows) & (np.abs(b[of_a] - a) <= within)
    return np.column_stack((rows[good], of_a[good]))


def median_interval(times: NDArray[np.float64]) -> float:
    """The median time from one to the next, seconds; infinite for fewer than two."""
    return float(np.median(np.diff(times))) if len(times) > 1 else float("inf")


def _nearest(a: NDArray[np.floating], b: NDArray[np.floating]) -> NDArray[np.int64]:
    """(N,) row of the time of b that is nearest to each of a."""
    after = np.searchsorted(b, a).clip(1, max(len(b) - 1, 1))
    after = np.minimum(after, len(b) - 1)
    before = np.maximum(after - 1, 0)
    return np.where(np.abs(b[before] - a) <= np.abs(b[after] - a), before, after)
