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

    iterations: largest number of steps at each level, coarsest first.  photometric: weight of the intensities.
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
    for done in range(len(iterations)):
        level = len(iterations) - 1 - done
        for _ in range(iterations[done]):
            linearize(source[level], target[level], camera, T, 1 << level, weighting, equations)
            if equations.statistics[2] < LEAST_MET:
                return
            information, gradient = eliminate_brightness(H, g)
            information, gradient, _ = remove_undetermined(information, gradient)
            for a in range(6):
                information[a, a] += DAMPING[0] * information[a, a] + DAMPING[1]
            step = np.linalg.solve(information, -gradient)
            D = np.ascontiguousarray(H[6:, 6:])
            D[0, 0] += BRIGHTNESS_DAMPING
            D[1, 1] += BRIGHTNESS_DAMPING
            weighting.brightness[:] += np.linalg.solve(D, -g[6:] - np.ascontiguousarray(H[6:, :6]) @ step)
            apply_twist(T, step)
            if np.abs(step).max() < STILL:
                break


@njit(nogil=True, cache=True)
def remove_undetermined(
    H: NDArray[np.float64], g: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], bool]:
    """(6, 6), (6,) normal equations without the contribution of noise in the normals, and whether every direction keeps
    some information. If the fitted normals of a bare plane are off by a few hundredths, the plane seems to resist a
    slide by the square of that."""
    scale = np.array((ARM_M, ARM_M, ARM_M, 1.0, 1.0, 1.0))
    values, vectors = np.linalg.eigh(H / np.outer(scale, scale))
    least = NORMALS_NOISE * values[5]
    kept = np.maximum(values - least, 0.0)
    share = kept / np.maximum(values, _TINY)
    H_out = (vectors * kept) @ vectors.T * np.outer(scale, scale)
    g_out = (vectors * share) @ (vectors.T @ (g / scale)) * scale
    return H_out, g_out, values[0] > 2.0 * least


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
    W2 = W @ W
    R = np.eye(3) + A * W + B * W2
    V = np.eye(3) + B * W + C * W2
    t = V @ xi[3:6]
    old = T[:3].copy()
    T[:3] = R @ old
    T[:3, 3] += t


@njit(nogil=True, cache=True)
def eliminate_brightness(
    H: NDArray[np.float64], g: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(6, 6), (6,) normal equations of xi: eliminates gain and offset from (8, 8), (8,)."""
    D = np.ascontiguousarray(H[6:, 6:])
    D[0, 0] += BRIGHTNESS_DAMPING
    D[1, 1] += BRIGHTNESS_DAMPING
    C = np.ascontiguousarray(H[6:, :6])
    X = np.ascontiguousarray(np.linalg.solve(D, C).T)
    return H[:6, :6] - X @ C, g[:6] - X @ g[6:]
