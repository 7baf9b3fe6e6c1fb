"""Pairs the images of two streams, color and depth: each with the nearest in time of the other."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...core.errors import CaptureError
from ...core.warnings import Notice

_SLACK = 1.1  # of half an interval, for jitter

Times = NDArray[np.floating]
"""(N,) seconds, ascending."""


def pair_streams(
    path: Path, times: tuple[Times, Times], other: tuple[Times, Times] | None = None
) -> tuple[NDArray[np.int64], tuple[Notice, ...]]:
    """(P, 2) rows of the color and depth images that belong together, and a warning about those without a partner
    within half the shorter interval.

    times: of color and depth.  other: times of another clock, which count if nothing pairs by the first. Raises
    CaptureError if nothing pairs.
    """
    within = 0.5 * _SLACK * min(map(median_interval, times))
    pairs = pair_nearest(*times, within)
    if not len(pairs) and other is not None:
        pairs = pair_nearest(*other, within)
    counts = tuple(map(len, times))
    if not len(pairs):
        raise CaptureError(
            f"{path} holds {counts[0]} color and {counts[1]} depth images, but no two of them are of the same time: "
            "map color only with capture.depth=false."
        )
    left = [count - len(pairs) for count in counts]
    if not any(left):
        return pairs, ()
    alone = [f"{n} {kind} image{'s' * (n > 1)}" for n, kind in zip(left, ("color", "depth"), strict=True) if n]
    text = (
        f"Of {counts[0]} color and {counts[1]} depth images of {path}, {' and '.join(alone)} without a partner within "
        f"{within * 1e3:.0f} ms {'is' if sum(left) == 1 else 'are'} left out."
    )
    return pairs, (Notice("images-left-out", text),)


def pair_nearest(a: Times, b: Times, within: float) -> NDArray[np.int64]:
    """(P, 2) rows of (N,) and (M,) times that are each other's nearest, at most ``within`` seconds apart."""
    if not len(a) or not len(b):
        return np.zeros((0, 2), np.int64)
    of_a, of_b = _nearest(a, b), _nearest(b, a)
    rows = np.arange(len(a))
    good = (of_b[of_a] == rows) & (np.abs(b[of_a] - a) <= within)
    return np.column_stack((rows[good], of_a[good]))


def median_interval(times: Times) -> float:
    """The median time from one to the next, seconds; infinite for fewer than two."""
    return float(np.median(np.diff(times))) if len(times) > 1 else float("inf")


def _nearest(a: Times, b: Times) -> NDArray[np.int64]:
    """(N,) row of the time of b that is nearest to each of a."""
    after = np.searchsorted(b, a).clip(0, len(b) - 1)
    before = np.maximum(after - 1, 0)
    return np.where(np.abs(b[before] - a) <= np.abs(b[after] - a), before, after)
