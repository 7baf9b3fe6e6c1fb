"""The mass of a 3D Gaussian within each voxel of a box of voxels.

With the axes ordered so that the last has the smallest conditional variance, the mass of N(mu, Sigma) in a voxel is

    int_x N(x) int_y N(y | x) [Phi((z1 - m(x, y)) / s) - Phi((z0 - m(x, y)) / s)] dy dx,

The innermost integral has a closed form. Gauss-Legendre nodes give the other two, over the part of the voxel that lies
within 5 standard deviations; a thinner Gaussian gets finer nodes. A Gaussian along the lattice's axes has three
separate integrals, all in closed form.

Source of the ordering and of the sequential conditioning: A. Genz, Numerical Computation of Multivariate Normal
Probabilities, J. Comput. Graph. Statist. 1(2), 1992.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ..core.compiling import njit
from ..core.types import BLOCK

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(8)
_FAR = 5.0  # standard deviations: 6e-7 of the mass lies beyond
_PER_PANEL = 5  # deviations across a panel: its eight nodes integrate that much exactly enough
_MOST_PANELS = 12  # enough down to deviations of a twentieth of a voxel
_ALIGNED = 1e-6  # largest ratio of the covariances to the variances for which axes count as independent
_TINY_VARIANCE = 1e-12  # squared voxels: rounding may make a flat Gaussian's variance negative


@njit(cache=True)
def integrate_boxes(
    mean: NDArray[np.float32],
    covariance: NDArray[np.float32],
    key: NDArray[np.int32],
    i0: int,
    j0: int,
    k0: int,
    i1: int,
    j1: int,
    k1: int,
    out: NDArray[np.float64],
) -> None:
    """Writes the mass within voxels [i0, i1) x [j0, j1) x [k0, k1) of block ``key`` to ``out`` (8, 8, 8).

    mean: (3,) and covariance: (6,) xx, xy, xz, yy, yz, zz of the Gaussian, in voxels.
    """
    S = np.array(
        (
            (covariance[0], covariance[1], covariance[2]),
            (covariance[1], covariance[3], covariance[4]),
            (covariance[2], covariance[4], covariance[5]),
        ),
        np.float64,
    )
    local = np.empty(3)
    for axis in range(3):
        local[axis] = np.float64(mean[axis]) - key[axis] * BLOCK
    first, end = (i0, j0, k0), (i1, j1, k1)
    mixed = abs(S[0, 1]) + abs(S[0, 2]) + abs(S[1, 2])
    if mixed <= _ALIGNED * (S[0, 0] + S[1, 1] + S[2, 2]):
        along = np.empty((3, BLOCK))
        for axis in range(3):
            deviation = math.sqrt(S[axis, axis])
            below = _phi((first[axis] - local[axis]) / deviation)
            for voxel in range(first[axis], end[axis]):
                up_to = _phi((voxel + 1 - local[axis]) / deviation)
                along[axis, voxel] = up_to - below
                below = up_to
        for i in range(i0, i1):
            for j in range(j0, j1):
                for k in range(k0, k1):
                    out[i, j, k] = along[0, i] * along[1, j] * along[2, k]
        return
    # The variance of an axis, given the other two, is the inverse of its entry on the precision's diagonal.
    order = np.argsort(
        np.array(
            (
                -(S[1, 1] * S[2, 2] - S[1, 2] * S[1, 2]),
                -(S[0, 0] * S[2, 2] - S[0, 2] * S[0, 2]),
                -(S[0, 0] * S[1, 1] - S[0, 1] * S[0, 1]),
            )
        )
    )[::-1]
    _integrated(S, local, order, first, end, out)


@njit(cache=True)
def _integrated(
    S: NDArray[np.float64],
    local: NDArray[np.float64],
    order: NDArray[np.int64],
    first: tuple[int, int, int],
    end: tuple[int, int, int],
    out: NDArray[np.float64],
) -> None:
    x, y, z = order[0], order[1], order[2]
    sx = math.sqrt(S[x, x])
    slope_yx = S[x, y] / S[x, x]
    sy = math.sqrt(max(S[y, y] - slope_yx * S[x, y], _TINY_VARIANCE))
    residual = S[y, z] - slope_yx * S[x, z]
    slope_zx, slope_zy = S[x, z] / S[x, x], residual / (sy * sy)
    sz = math.sqrt(max(S[z, z] - slope_zx * S[x, z] - slope_zy * residual, _TINY_VARIANCE))
    # Panels are narrow: across one, the density and the inner integral move by a few deviations at most.
    panels_x = _panels(abs(slope_zx) / sz + abs(slope_yx) / sy + min(1 / sx, 2 * _FAR))
    panels_y = _panels(abs(slope_zy) / sz + min(1 / sy, 2 * _FAR))
    below, at = np.empty(BLOCK), np.empty(3, np.int64)
    for vx in range(first[x], end[x]):
        for vy in range(first[y], end[y]):
            below[:] = 0.0
            x_from, x_to = max(vx, local[x] - _FAR * sx), min(vx + 1, local[x] + _FAR * sx)
            for px in range(panels_x if x_to > x_from else 0):
                half_x = 0.5 * (x_to - x_from) / panels_x
                for nx in range(len(_NODES)):
                    dx = x_from + half_x * (2 * px + 1 + _NODES[nx]) - local[x]
                    weight_x = half_x * _WEIGHTS[nx] * math.exp(-0.5 * (dx / sx) ** 2) / sx
                    my = local[y] + slope_yx * dx
                    y_from, y_to = max(vy, my - _FAR * sy), min(vy + 1, my + _FAR * sy)
                    for py in range(panels_y if y_to > y_from else 0):
                        half_y = 0.5 * (y_to - y_from) / panels_y
                        for ny in range(len(_NODES)):
                            dy = y_from + half_y * (2 * py + 1 + _NODES[ny]) - my
                            weight = weight_x * half_y * _WEIGHTS[ny] * math.exp(-0.5 * (dy / sy) ** 2) / sy
                            mz = local[z] + slope_zx * dx + slope_zy * dy
                            last = _phi((first[z] - mz) / sz)
                            for vz in range(first[z], end[z]):
                                up_to = _phi((vz + 1 - mz) / sz)
                                below[vz] += weight * (up_to - last)
                                last = up_to
            at[x], at[y] = vx, vy
            for vz in range(first[z], end[z]):
                at[z] = vz
                out[at[0], at[1], at[2]] = below[vz] / (2 * math.pi)


@njit(cache=True)
def _panels(deviations: float) -> int:
    """Returns the number of pieces of a voxel's edge. deviations: how far the integrand moves along the edge."""
    return min(math.ceil(deviations / _PER_PANEL), _MOST_PANELS)


@njit(cache=True)
def _phi(x: float) -> float:
    """The standard normal distribution function."""
    return 0.5 * math.erfc(-x * math.sqrt(0.5))
