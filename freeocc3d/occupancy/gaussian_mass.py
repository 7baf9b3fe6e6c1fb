"""The mass of a Gaussian in voxels: the share of evenly spread points of the Gaussian that lie in each.

The points mu + L x_n, L L^T = Sigma, come from a fixed sequence x_n of the standard normal distribution, the same for
all Gaussians: Roberts' sequence, whose every beginning is spread evenly, through the inverse of the distribution
function, and changed a little so that every 128 points have exactly its mean and covariance. A Gaussian gets more
points if its neighborhood has more voxels. A mass is exact to about a hundredth
(``tests/occupancy/test_splat.py`` compares it with quadrature), in a fiftieth of quadrature's time.

Source: M. Roberts, The Unreasonable Effectiveness of Quasirandom Sequences, 2018 (generalized golden ratios).
"""

from __future__ import annotations

import math
from statistics import NormalDist

import numpy as np
from numpy.typing import NDArray

from ..core.compiling import njit
from ..core.types import BLOCK

_FEWEST, _MOST, _PER_VOXEL = 128, 4096, 4
"""Points of a Gaussian: at least, at most, and about that many for each voxel of its neighborhood's box."""

_RATIO = 1.2207440846057596
"""The generalized golden ratio of three dimensions: the root of x^4 = x + 1."""

_LEAST_VARIANCE = 1e-12
"""Squared voxels: rounding may make a flat Gaussian's variance negative."""


def _spread_points(count: int) -> NDArray[np.float64]:
    """Returns (count, 3) points of the standard normal distribution."""
    even = (0.5 + np.outer(np.arange(1, count + 1), _RATIO ** -np.arange(1.0, 4.0))) % 1.0
    points = np.vectorize(NormalDist().inv_cdf)(even).reshape(-1, _FEWEST, 3)
    points -= points.mean(axis=1, keepdims=True)
    roots = np.linalg.cholesky(np.swapaxes(points, 1, 2) @ points / _FEWEST)
    return np.linalg.solve(roots, np.swapaxes(points, 1, 2)).swapaxes(1, 2).reshape(-1, 3)


POINTS = _spread_points(_MOST)
"""(4096, 3) the points; a Gaussian uses the first ``count_points`` of them."""


@njit(cache=True)
def count_points(lo: NDArray[np.int32], hi: NDArray[np.int32]) -> int:
    """Returns the number of points of a Gaussian whose neighborhood is the box of the voxels lo … hi (3,)."""
    box = 1.0
    for axis in range(3):
        box *= max(hi[axis] - lo[axis] + 1.0, 0.0)
    return int(min(max(math.ceil(_PER_VOXEL * box / _FEWEST), 1), _MOST // _FEWEST)) * _FEWEST


@njit(cache=True)
def count_points_of_all(lo: NDArray[np.int32], hi: NDArray[np.int32]) -> NDArray[np.int64]:
    """Returns the (N,) numbers of points of Gaussians with the boxes lo … hi (N, 3)."""
    count = np.empty(len(lo), np.int64)
    for g in range(len(lo)):
        count[g] = count_points(lo[g], hi[g])
    return count


@njit(cache=True)
def measure_boxes(
    mean: NDArray[np.float32],
    covariance: NDArray[np.float32],
    count: int,
    key: NDArray[np.int32],
    first: tuple[int, int, int],
    end: tuple[int, int, int],
    out: NDArray[np.float64],
) -> None:
    """Writes the mass within the voxels from ``first`` to before ``end`` of block ``key`` to ``out`` (8, 8, 8).

    mean: (3,) and covariance: (6,) xx, xy, xz, yy, yz, zz of the Gaussian, in voxels.  count: of points.
    """
    out[first[0] : end[0], first[1] : end[1], first[2] : end[2]] = 0.0
    # Cholesky's factor
    a = math.sqrt(covariance[0])
    b, c = covariance[1] / a, covariance[2] / a
    d = math.sqrt(max(covariance[3] - b * b, _LEAST_VARIANCE))
    e = (covariance[4] - b * c) / d
    f = math.sqrt(max(covariance[5] - c * c - e * e, _LEAST_VARIANCE))
    x0, y0, z0 = mean[0] - key[0] * BLOCK, mean[1] - key[1] * BLOCK, mean[2] - key[2] * BLOCK
    one = 1.0 / count
    for n in range(count):
        p, q, r = POINTS[n, 0], POINTS[n, 1], POINTS[n, 2]
        i, j, k = math.floor(x0 + a * p), math.floor(y0 + b * p + d * q), math.floor(z0 + c * p + e * q + f * r)
        if first[0] <= i < end[0] and first[1] <= j < end[1] and first[2] <= k < end[2]:
            out[i, j, k] += one
