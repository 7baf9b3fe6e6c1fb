"""Dense alignment of two RGB-D views: projective point-to-plane and photometric residuals, Gauss-Newton, robust.

With p a source point and p' = T p, n and q the target's normal and point where p' projects, I the intensities,

    r_g = n^T (p' - q),            weighed by 1 / sigma(z)^2                                                        (1)
    r_p = I_t(pi(p')) - (gain I_s(p) + offset)                                                                      (2)
    T <- exp(xi) T,   xi = argmin sum rho(r_g / s_g) + photometric sum rho(r_p / s_p)                               (3)

with s from the residuals' median absolute deviation and rho the Geman-McClure function. Gain and offset are solved for
together with xi, so that a change of exposure moves nothing. What the residuals do not determine, such as a slide along
a bare wall, is told by the eigenvalues of the normal equations and stays as it was guessed (``remove_undetermined``).

Sources: Y. Chen, G. Medioni, Object Modelling by Registration of Multiple Range Images, IVC 1992 (1); C. Kerl, J.
Sturm, D. Cremers, Dense Visual SLAM for RGB-D Cameras, IROS 2013 (2); J. Zhang, M. Kaess, S. Singh, On Degeneracy of
Optimization-based State Estimation Problems, ICRA 2016.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ...core.transforms import nearest_rigid
from .alignment_views import AlignmentView

PHOTOMETRIC = 0.2
"""Weight of the intensities: neighbouring ones are far from independent."""


@dataclass(frozen=True)
class ViewAlignment:
    """The pose of a source view in a target view.

    T_target_source: (4, 4).  information: (6, 6) at it, rotation before translation, for T <- exp(xi) T, without what
    is not determined.  determined: whether all of it is.
    overlap: share of the source's surface that falls on the target's view.  inliers: share of that which lies on the
    target's surface where it has one.  correlation: of the intensities there, -1…1, NaN where they hardly vary.
    """

    T_target_source: NDArray[np.float64]
    information: NDArray[np.float64]
    determined: bool
    overlap: float
    inliers: float
    correlation: float


_ARM = 2.0  # metres: a turn by one radian moves what is seen by so much
_NOISE = 1e-3  # share of the largest eigenvalue that noisy normals may pretend
_FLAT, _FEW = 0.015, 100  # standard deviation of intensities that say nothing; fewer pixels say nothing either

_COMPARED = 0.15  # share of what is in view that must meet a surface, not a hole

STATS = 10
"""Statistics that ``linearize`` counts."""

_BINS = 512
_PER_SIGMA = 16.0  # histogram bins per unit of a normalised residual


@njit(nogil=True, cache=True, fastmath=True, error_model="numpy")
def linearize(
    points_s: NDArray[np.float32],
    normals_s: NDArray[np.float32],
    gray_s: NDArray[np.float32],
    points_t: NDArray[np.float32],
    normals_t: NDArray[np.float32],
    gray_t: NDArray[np.float32],
    camera: NDArray[np.float64],
    T: NDArray[np.float64],
    stride: int,
    brightness: NDArray[np.float64],
    scales: NDArray[np.float64],
    photometric: float,
    H: NDArray[np.float64],
    g: NDArray[np.float64],
    stats: NDArray[np.float64],
) -> None:
    """Fill the normal equations (8, 8), (8,) of xi, gain and offset at T, and statistics.

    camera: fx, fy, cx, cy of the full-size images; the gray images may be smaller by a power of two.
    brightness: gain, offset.  scales: s_g, s_p, in and out: updated from these residuals for the next call.
    stats, out: source pixels with a surface, of these in view, of these where the target has a surface too, of these on
    it; then of the pixels that were compared by intensity their number and the sums of s, t, s s, t t, s t.
    """
    h, w = points_s.shape[:2]
    ht, wt = points_t.shape[:2]
    fx, fy, cx, cy = camera
    shrink = gray_t.shape[1] / wt
    hg, wg = gray_t.shape
    H[:] = 0.0
    g[:] = 0.0
    stats[:] = 0.0
    histogram_g = np.zeros(_BINS, np.int64)
    histogram_p = np.zeros(_BINS, np.int64)
    count_g = 0
    count_p = 0
    # GM's rho' is 1 / (1 + (r / (2.4 s))^2)^2
    soft_g = 1.0 / (2.4 * scales[0]) ** 2
    soft_p = 1.0 / (2.4 * scales[1]) ** 2
    gain, offset = brightness
    J = np.zeros(8)
    first = stride // 2
    for i in range(first, h, stride):
        for j in range(first, w, stride):
            ps0, ps1, ps2 = points_s[i, j, 0], points_s[i, j, 1], points_s[i, j, 2]
            if ps2 == 0.0:
                continue
            stats[0] += 1
            x = T[0, 0] * ps0 + T[0, 1] * ps1 + T[0, 2] * ps2 + T[0, 3]
            y = T[1, 0] * ps0 + T[1, 1] * ps1 + T[1, 2] * ps2 + T[1, 3]
            z = T[2, 0] * ps0 + T[2, 1] * ps1 + T[2, 2] * ps2 + T[2, 3]
            if z < 0.1:
                continue
            u = fx * x / z + cx
            v = fy * y / z + cy
            if u < 0.5 or v < 0.5 or u > wt - 1.5 or v > ht - 1.5:
                continue
            stats[1] += 1
            jt, it = int(u + 0.5), int(v + 0.5)
            q0, q1, q2 = points_t[it, jt, 0], points_t[it, jt, 1], points_t[it, jt, 2]
            if q2 == 0.0:
                continue
            stats[2] += 1
            n0, n1, n2 = normals_t[it, jt, 0], normals_t[it, jt, 1], normals_t[it, jt, 2]
            m0 = T[0, 0] * normals_s[i, j, 0] + T[0, 1] * normals_s[i, j, 1] + T[0, 2] * normals_s[i, j, 2]
            m1 = T[1, 0] * normals_s[i, j, 0] + T[1, 1] * normals_s[i, j, 1] + T[1, 2] * normals_s[i, j, 2]
            m2 = T[2, 0] * normals_s[i, j, 0] + T[2, 1] * normals_s[i, j, 1] + T[2, 2] * normals_s[i, j, 2]
            r = n0 * (x - q0) + n1 * (y - q1) + n2 * (z - q2)
            sigma_t = 0.0012 + 0.0019 * (q2 - 0.4) ** 2
            sigma_s = 0.0012 + 0.0019 * (ps2 - 0.4) ** 2
            sigma = math.sqrt(sigma_t * sigma_t + sigma_s * sigma_s)
            k = abs(r) / sigma
            bin_ = int(k * _PER_SIGMA)
            if n0 * m0 + n1 * m1 + n2 * m2 < 0.6:
                continue
            if bin_ < _BINS:
                histogram_g[bin_] += 1
            count_g += 1
            weight = 1.0 / (1.0 + k * k * soft_g) ** 2
            if k < 3.0 * scales[0]:
                stats[3] += 1
            J[0] = y * n2 - z * n1
            J[1] = z * n0 - x * n2
            J[2] = x * n1 - y * n0
            J[3] = n0
            J[4] = n1
            J[5] = n2
            weight_g = weight / (sigma * sigma * scales[0] * scales[0])
            for a in range(6):
                wj = weight_g * J[a]
                g[a] += wj * r
                for b in range(a, 6):
                    H[a, b] += wj * J[b]
            # photometric, where the surface is the same one
            if k > 6.0 * scales[0] or photometric == 0.0:
                continue
            ug = (u + 0.5) * shrink - 0.5
            vg = (v + 0.5) * shrink - 0.5
            jg, ig = int(ug), int(vg)
            if ug < 0 or vg < 0 or jg >= wg - 1 or ig >= hg - 1:
                continue
            js = (j + 0.5) * shrink - 0.5
            is_ = (i + 0.5) * shrink - 0.5
            if shrink == 1.0:
                value_s = gray_s[i, j]
            else:
                a0, b0 = max(0, min(int(is_), gray_s.shape[0] - 2)), max(0, min(int(js), gray_s.shape[1] - 2))
                fa, fb = is_ - a0, js - b0
                value_s = (1 - fa) * ((1 - fb) * gray_s[a0, b0] + fb * gray_s[a0, b0 + 1]) + fa * (
                    (1 - fb) * gray_s[a0 + 1, b0] + fb * gray_s[a0 + 1, b0 + 1]
                )
            fu, fv = ug - jg, vg - ig
            g00, g01, g10, g11 = gray_t[ig, jg], gray_t[ig, jg + 1], gray_t[ig + 1, jg], gray_t[ig + 1, jg + 1]
            value_t = (1 - fv) * ((1 - fu) * g00 + fu * g01) + fv * ((1 - fu) * g10 + fu * g11)
            gu = ((1 - fv) * (g01 - g00) + fv * (g11 - g10)) * shrink
            gv = ((1 - fu) * (g10 - g00) + fu * (g11 - g01)) * shrink
            stats[4] += 1
            stats[5] += value_s
            stats[6] += value_t
            stats[7] += value_s * value_s
            stats[8] += value_t * value_t
            stats[9] += value_s * value_t
            rp = value_t - (gain * value_s + offset)
            kp = abs(rp) * 100.0
            bin_ = int(kp * _PER_SIGMA)
            if bin_ < _BINS:
                histogram_p[bin_] += 1
            count_p += 1
            weight_p = photometric / (1.0 + kp * kp * soft_p) ** 2 / (1e-4 * scales[1] * scales[1])
            d0, d1 = gu * fx / z, gv * fy / z
            d2 = -(d0 * x + d1 * y) / z
            J[0] = y * d2 - z * d1
            J[1] = z * d0 - x * d2
            J[2] = x * d1 - y * d0
            J[3] = d0
            J[4] = d1
            J[5] = d2
            J[6] = -value_s
            J[7] = -1.0
            for a in range(8):
                wj = weight_p * J[a]
                g[a] += wj * rp
                for b in range(a, 8):
                    H[a, b] += wj * J[b]
    for a in range(8):
        for b in range(a):
            H[a, b] = H[b, a]
    scales[0] = _spread(histogram_g, count_g, 0.5)
    scales[1] = _spread(histogram_p, count_p, 0.3)


@njit(nogil=True, cache=True)
def _spread(histogram: NDArray[np.int64], count: int, least: float) -> float:
    """Standard deviation from the median of absolute residuals, in units of their a-priori one."""
    total = 0
    for k in range(len(histogram)):
        total += histogram[k]
        if 2 * total >= count:
            return max(1.4826 * (k + 0.5) / _PER_SIGMA, least)
    return 1.4826 * len(histogram) / _PER_SIGMA


def align_views(
    source: AlignmentView,
    target: AlignmentView,
    T_target_source: NDArray[np.float64],
    iterations: tuple[int, ...] = (8, 6, 6),
    photometric: float = PHOTOMETRIC,
) -> ViewAlignment:
    """Refine the pose of ``source`` in ``target`` from a guess, coarse to fine.

    iterations: at most so many steps at each level, coarsest first.  photometric: weight of the intensities.
    """
    T = np.array(T_target_source, np.float64)
    H, g, stats = np.zeros((8, 8)), np.zeros(8), np.zeros(STATS)
    _descend(
        source.points, source.normals, source.gray, target.points, target.normals, target.gray,
        target.camera, T, np.array(iterations), photometric, H, g, stats,
    )  # fmt: skip
    information, _, determined = remove_undetermined(*eliminate_brightness(H, g))
    return ViewAlignment(
        nearest_rigid(T), information, bool(determined), float(stats[1] / max(stats[0], 1.0)),
        compute_inlier_share(stats), compute_correlation(stats),
    )  # fmt: skip


def compute_inlier_share(stats: NDArray[np.float64]) -> float:
    """Share of the pixels that lie on the target's surface, of those where it has one, from ``linearize``'s statistics;
    0 where too few have to tell."""
    return float(stats[3] / stats[2]) if stats[2] >= max(_FEW, _COMPARED * stats[1]) else 0.0


def compute_correlation(stats: NDArray[np.float64]) -> float:
    """Of the intensities of two views, from ``linearize``'s statistics."""
    n = max(stats[4], 1.0)
    s, t = stats[5] / n, stats[6] / n
    ss, tt, st = stats[7] / n - s * s, stats[8] / n - t * t, stats[9] / n - s * t
    flat = min(ss, tt) < _FLAT**2 or stats[4] < _FEW
    return float("nan") if flat else float(st / np.sqrt(ss * tt))


@njit(nogil=True, cache=True)
def _descend(
    points_s: NDArray[np.float32],
    normals_s: NDArray[np.float32],
    gray_s: tuple[NDArray[np.float32], ...],
    points_t: NDArray[np.float32],
    normals_t: NDArray[np.float32],
    gray_t: tuple[NDArray[np.float32], ...],
    camera: NDArray[np.float64],
    T: NDArray[np.float64],
    iterations: NDArray[np.int64],
    photometric: float,
    H: NDArray[np.float64],
    g: NDArray[np.float64],
    stats: NDArray[np.float64],
) -> None:
    """``align_views``'s loop: T is moved in place; H, g and stats are those of the last step's start."""
    scales = np.array((6.0, 10.0))
    brightness = np.array((1.0, 0.0))
    for done in range(len(iterations)):
        level = len(iterations) - 1 - done
        for _ in range(iterations[done]):
            linearize(
                points_s, normals_s, gray_s[level], points_t, normals_t, gray_t[level], camera, T, 1 << level,
                brightness, scales, photometric, H, g, stats,
            )  # fmt: skip
            if stats[2] < 30:
                return
            information, gradient = eliminate_brightness(H, g)
            information, gradient, _ = remove_undetermined(information, gradient)
            for a in range(6):
                information[a, a] += 1e-6 * information[a, a] + 1.0
            step = np.linalg.solve(information, -gradient)
            D = np.ascontiguousarray(H[6:, 6:])
            D[0, 0] += 1e-9
            D[1, 1] += 1e-9
            brightness += np.linalg.solve(D, -g[6:] - np.ascontiguousarray(H[6:, :6]) @ step)
            apply_twist(T, step)
            if np.abs(step).max() < 2e-4:
                break


@njit(nogil=True, cache=True)
def remove_undetermined(
    H: NDArray[np.float64], g: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], bool]:
    """(6, 6), (6,) normal equations without what noise in the normals alone would contribute, and whether something of
    each direction is left. A bare plane whose fitted normals are off by a few hundredths seems to resist a slide by the
    square of that."""
    scale = np.array((_ARM, _ARM, _ARM, 1.0, 1.0, 1.0))
    values, vectors = np.linalg.eigh(H / np.outer(scale, scale))
    least = _NOISE * values[5]
    kept = np.maximum(values - least, 0.0)
    share = kept / np.maximum(values, 1e-12)
    H_out = (vectors * kept) @ vectors.T * np.outer(scale, scale)
    g_out = (vectors * share) @ (vectors.T @ (g / scale)) * scale
    return H_out, g_out, values[0] > 2.0 * least


@njit(nogil=True, cache=True)
def apply_twist(T: NDArray[np.float64], xi: NDArray[np.float64]) -> None:
    """T <- exp(xi) T in place; rotation before translation."""
    angle = math.sqrt(xi[0] ** 2 + xi[1] ** 2 + xi[2] ** 2)
    W = np.array(((0.0, -xi[2], xi[1]), (xi[2], 0.0, -xi[0]), (-xi[1], xi[0], 0.0)))
    if angle < 1e-7:
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
    """(6, 6), (6,) normal equations of xi alone, gain and offset eliminated from (8, 8), (8,)."""
    D = np.ascontiguousarray(H[6:, 6:])
    D[0, 0] += 1e-9
    D[1, 1] += 1e-9
    C = np.ascontiguousarray(H[6:, :6])
    X = np.ascontiguousarray(np.linalg.solve(D, C).T)
    return H[:6, :6] - X @ C, g[:6] - X @ g[6:]
