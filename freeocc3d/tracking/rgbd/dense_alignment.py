"""Dense alignment of two RGB-D views: projective point-to-plane and photometric residuals, Gauss-Newton, robust.

With the residuals r_g and r_p of ``dense_residuals`` and their spreads s_g and s_p,

    T <- exp(xi) T,   xi = argmin sum rho(r_g / s_g) + photometric sum rho(r_p / s_p)                               (3)

with s from the median absolute deviation of the residuals and the robust kernel rho of Geman and McClure. Gain and
offset are solved together with xi, so a change of exposure does not affect the pose. The eigenvalues of the normal
equations show which directions the residuals do not determine, such as a slide along a bare wall. These keep the
initial guess (``remove_undetermined``).

Source: J. Zhang, M. Kaess, S. Singh, On Degeneracy of Optimization-based State Estimation Problems, ICRA 2016.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...core.compiling import njit
from ...core.transforms import nearest_rigid
from .alignment_views import AlignmentView
from .dense_residuals import NormalEquations, Surface, Weighting, linearize, make_equations

PHOTOMETRIC = 0.2
"""Weight of the intensities. It is low, because neighboring intensities are far from independent."""


@dataclass(frozen=True)
class ViewAlignment:
    """The pose of a source view in a target view.

    T_target_source: (4, 4).  information: (6, 6) for T <- exp(xi) T, rotation before translation, without undetermined
    directions.  determined: whether all directions are determined.
    overlap: share of the source's surface that projects into the target's view.  inliers: share of these pixels that
    lie on the target's surface, where it has one.  correlation: of their intensities, -1…1; NaN if they hardly vary.
    """

    T_target_source: NDArray[np.float64]
    information: NDArray[np.float64]
    determined: bool
    overlap: float
    inliers: float
    correlation: float


ARM_M = 2.0
"""Distance at which rotations are compared with translations: one radian counts as this many meters."""

NORMALS_NOISE = 1e-3
"""Share of the largest eigenvalue that noise in the normals adds to every eigenvalue: an error of 0.03, squared."""

FLAT, FEW = 0.015, 100
"""Smallest useful standard deviation of intensities, 4 steps of 8 bits, and smallest useful number of pixels."""

COMPARED = 0.15
"""Share of the pixels in view that must meet a surface, not a hole."""

FIRST_SPREADS = (6.0, 10.0)
"""Initial s of depth and of intensities: an initial guess is off by a few centimeters."""

LEAST_MET = 30
"""Source pixels that must meet the target's surface for a step: five per unknown of the pose."""

DAMPING = (1e-6, 1.0)
"""Terms added to the diagonal of the normal equations: a share of it and a constant, in 1 / m^2. They only keep
undetermined directions from moving."""

BRIGHTNESS_DAMPING = 1e-9
"""Added to the information of gain and offset, so that they stay if no intensity is compared."""

STILL = 2e-4
"""Radians and meters: a smaller step ends the level."""

_STRIDE = 2
"""Step between source pixels before the last step. Neighboring pixels carry nearly the same information: the fits of
their planes share most depths, and the blurred image much of its noise."""

_SMALL_ANGLE = 1e-7  # radians: below it sin(x) / x and similar terms equal their limits, up to rounding
_TINY = 1e-12  # avoids a division by eigenvalues of exactly 0


def align_views(
    source: AlignmentView,
    target: AlignmentView,
    T_target_source: NDArray[np.float64],
    iterations: tuple[int, ...] = (8, 6, 6),
    photometric: float = PHOTOMETRIC,
) -> ViewAlignment:
    """Refine the pose of ``source`` in ``target`` from an initial guess, coarse to fine.

    iterations: largest number of steps at each level, coarsest first; one more step compares every pixel.
    photometric: weight of the intensities.
    """
    T = np.array(T_target_source, np.float64)
    equations = make_equations()
    _descend(source.levels, target.levels, target.camera, T, np.array(iterations), photometric, equations)
    information, _, determined = remove_undetermined(*eliminate_brightness(equations.H, equations.g))
    stats = equations.statistics
    return ViewAlignment(
        nearest_rigid(T), information, bool(determined), float(stats[1] / max(stats[0], 1.0)),
        compute_inlier_share(stats), compute_correlation(stats),
    )  # fmt: skip


def compute_inlier_share(stats: NDArray[np.float64]) -> float:
    """Share of inliers among the pixels that meet the target's surface, from ``linearize``'s statistics; 0 with too few
    pixels."""
    return float(stats[3] / stats[2]) if stats[2] >= max(FEW, COMPARED * stats[1]) else 0.0


def compute_correlation(stats: NDArray[np.float64]) -> float:
    """Correlation of the intensities of two views, from ``linearize``'s statistics; NaN if they hardly vary."""
    n = max(stats[4], 1.0)
    s, t = stats[5] / n, stats[6] / n
    ss, tt, st = stats[7] / n - s * s, stats[8] / n - t * t, stats[9] / n - s * t
    flat = min(ss, tt) < FLAT**2 or stats[4] < FEW
    return float("nan") if flat else float(st / np.sqrt(ss * tt))


@njit(nogil=True, cache=True)
def _descend(
    source: tuple[Surface, ...],
    target: tuple[Surface, ...],
    camera: NDArray[np.float64],
    T: NDArray[np.float64],
    iterations: NDArray[np.int64],
    photometric: float,
    equations: NormalEquations,
) -> None:
    """The loop of ``align_views`` over levels and steps. Updates T in place; the equations are those at the start of
    the last step."""
    H, g = equations.H, equations.g
    weighting = Weighting(np.array(FIRST_SPREADS), np.array((1.0, 0.0)), photometric)
    levels = len(iterations)
    for done in range(levels + 1):
        last = done == levels  # one step that compares every pixel
        level = 0 if last else levels - 1 - done
        stride = 1 if last else max(_STRIDE, 1 << level)
        for _ in range(1 if last else iterations[done]):
            linearize(source[level], target[level], camera, T, stride, weighting, equations)
            if equations.statistics[2] < LEAST_MET:
                return
            information, gradient = eliminate_brightness(H, g)
            information, gradient, _ = remove_undetermined(information, gradient)
            for a in range(6):
                information[a, a] += DAMPING[0] * information[a, a] + DAMPING[1]
            step = _solve(information, -gradient)
            _update_brightness(weighting.brightness, H, g, step)
            apply_twist(T, step)
            if _largest(step) < STILL:
                break


@njit(nogil=True, cache=True)
def remove_undetermined(
    H: NDArray[np.float64], g: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], bool]:
    """(6, 6), (6,) normal equations without the contribution of noise in the normals, and whether every direction keeps
    some information. If the fitted normals of a bare plane are off by a few hundredths, the plane seems to resist a
    slide by the square of that."""
    scaled = H.copy()
    for a in range(6):
        for b in range(6):
            scaled[a, b] /= _scale(a) * _scale(b)
    values, vectors = np.linalg.eigh(scaled)
    least = NORMALS_NOISE * values[5]
    H_out = np.zeros((6, 6))
    g_out = np.zeros(6)
    for k in range(6):
        kept = max(values[k] - least, 0.0)
        along = 0.0
        for a in range(6):
            along += vectors[a, k] * g[a] / _scale(a)
        for a in range(6):
            g_out[a] += kept / max(values[k], _TINY) * along * vectors[a, k] * _scale(a)
            for b in range(6):
                H_out[a, b] += kept * vectors[a, k] * _scale(a) * vectors[b, k] * _scale(b)
    return H_out, g_out, values[0] > 2.0 * least


@njit(nogil=True, cache=True, inline="always")
def _scale(unknown: int) -> float:
    return ARM_M if unknown < 3 else 1.0


@njit(nogil=True, cache=True)
def apply_twist(T: NDArray[np.float64], xi: NDArray[np.float64]) -> None:
    """T <- exp(xi) T in place; rotation before translation."""
    angle = math.sqrt(xi[0] ** 2 + xi[1] ** 2 + xi[2] ** 2)
    W = np.array(((0.0, -xi[2], xi[1]), (xi[2], 0.0, -xi[0]), (-xi[1], xi[0], 0.0)))
    if angle < _SMALL_ANGLE:
        A, B, C = 1.0, 0.5, 1.0 / 6.0
    else:
        A = math.sin(angle) / angle
        B = (1.0 - math.cos(angle)) / angle**2
        C = (1.0 - A) / angle**2
    R = np.eye(3)
    V = np.eye(3)
    for i in range(3):
        for j in range(3):
            squared = W[i, 0] * W[0, j] + W[i, 1] * W[1, j] + W[i, 2] * W[2, j]
            R[i, j] += A * W[i, j] + B * squared
            V[i, j] += B * W[i, j] + C * squared
    for j in range(4):
        x, y, z = T[0, j], T[1, j], T[2, j]
        for i in range(3):
            T[i, j] = R[i, 0] * x + R[i, 1] * y + R[i, 2] * z
    for i in range(3):
        T[i, 3] += V[i, 0] * xi[3] + V[i, 1] * xi[4] + V[i, 2] * xi[5]


@njit(nogil=True, cache=True)
def eliminate_brightness(
    H: NDArray[np.float64], g: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(6, 6), (6,) normal equations of xi: eliminates gain and offset from (8, 8), (8,)."""
    H_out = np.empty((6, 6))
    g_out = np.empty(6)
    i, j, k = _invert_brightness(H)
    for a in range(6):
        gain, offset = i * H[6, a] + j * H[7, a], j * H[6, a] + k * H[7, a]
        g_out[a] = g[a] - (gain * g[6] + offset * g[7])
        for b in range(6):
            H_out[a, b] = H[a, b] - (gain * H[6, b] + offset * H[7, b])
    return H_out, g_out


@njit(nogil=True, cache=True)
def _update_brightness(
    brightness: NDArray[np.float64], H: NDArray[np.float64], g: NDArray[np.float64], step: NDArray[np.float64]
) -> None:
    """Add the gain and offset that belong to a step of the pose."""
    left_gain, left_offset = -g[6], -g[7]
    for a in range(6):
        left_gain -= H[6, a] * step[a]
        left_offset -= H[7, a] * step[a]
    i, j, k = _invert_brightness(H)
    brightness[0] += i * left_gain + j * left_offset
    brightness[1] += j * left_gain + k * left_offset


@njit(nogil=True, cache=True)
def _invert_brightness(H: NDArray[np.float64]) -> tuple[float, float, float]:
    """The inverse of the damped information of gain and offset: first entry, off the diagonal, last entry."""
    gain, both, offset = H[6, 6] + BRIGHTNESS_DAMPING, H[6, 7], H[7, 7] + BRIGHTNESS_DAMPING
    determinant = gain * offset - both * both
    return offset / determinant, -both / determinant, gain / determinant


@njit(nogil=True, cache=True)
def _solve(A: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """x with A x = b for a positive definite A, which Cholesky's decomposition overwrites."""
    n = len(b)
    x = np.empty(n)
    for i in range(n):
        for j in range(i + 1):
            left = A[i, j]
            for k in range(j):
                left -= A[i, k] * A[j, k]
            A[i, j] = left / A[j, j] if j < i else math.sqrt(left)
        left = b[i]
        for k in range(i):
            left -= A[i, k] * x[k]
        x[i] = left / A[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            x[i] -= A[k, i] * x[k]
        x[i] /= A[i, i]
    return x


@njit(nogil=True, cache=True)
def _largest(step: NDArray[np.float64]) -> float:
    largest = 0.0
    for value in step:
        largest = max(largest, abs(value))
    return largest
