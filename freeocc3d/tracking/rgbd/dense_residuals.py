"""Residuals of two RGB-D views and their normal equations.

p is a source point, p' = T p; n and q are the target's normal and point at the projection of p'; I are intensities:

    r_g = n^T (p' - q),            weighted by 1 / sigma(z)^2                                                       (1)
    r_p = I_t(pi(p')) - (gain I_s(p) + offset)                                                                      (2)

Each is weighted by the Geman-McClure robust kernel, rho'(r) = 1 / (1 + (r / c)^2)^2, with c = ``GEMAN_MCCLURE`` s. s
is the spread of the residuals in units of their expected standard deviation.

Sources: Y. Chen, G. Medioni, Object Modelling by Registration of Multiple Range Images, IVC 1992 (1); C. Kerl, J.
Sturm, D. Cremers, Dense Visual SLAM for RGB-D Cameras, IROS 2013 (2).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...core.compiling import njit
from ...core.depth_noise import MAD_TO_SIGMA, look_up_sigma

NEAREST_M = 0.1
"""Smallest distance of a point in front of the target's camera, meters. Nearer, projection is unstable."""

GEMAN_MCCLURE = 2.4
"""Spreads at which a residual's weight falls to a quarter. The weight is the square of Cauchy's weight, which has 95 %
efficiency on Gaussian residuals at 2.385 (Z. Zhang, Parameter Estimation Techniques, IVC 1997)."""

NORMALS_AGREE = 0.6
"""Smallest cosine between the normals of two views of one surface: 53 degrees, because each fitted normal of noisy
depth is off by up to half of that."""

ON_SURFACE = 3.0
"""Spreads within which a point counts as on the target's surface: 99.7 % of Gaussian residuals."""

SAME_SURFACE = 6.0
"""Spreads beyond which a point belongs to another surface, so that its intensity does not count."""

GRAY_SIGMA = 0.01
"""Expected standard deviation of intensities 0…1: noise and rounding of 8-bit images, two to three steps."""

LEAST_SPREAD = (0.5, 0.3)
"""Smallest s of the depth and intensity residuals; with smaller values, single pixels would decide."""

STATISTICS = 10
"""Length of ``NormalEquations.statistics``."""

_BINS = 512
_PER_SIGMA = 16.0  # histogram bins per unit of a normalized residual: spreads to 3 %, residuals up to 32
_EXPOSURE = 8  # unknowns: rotation, translation, gain, offset
_POSE = 6


class Surface(NamedTuple):
    """The parts of a view that the residuals use.

    points: (h, w, 3) camera frame, meters; z = 0 without a surface.  normals: (h, w, 3) unit.  sigma_m: (h, w)
    standard deviations of the points' depth, meters, or the sensor's coefficients (``depth_noise.take_sigma``).  gray:
    intensities 0…1 of the same view, its size times a power of two smaller.
    """

    points: NDArray[np.float32]
    normals: NDArray[np.float32]
    sigma_m: NDArray[np.float32]
    gray: NDArray[np.float32]


class Weighting(NamedTuple):
    """Weights of the residuals; both arrays change from step to step.

    spreads: s of the depth residuals and of the intensity residuals; ``linearize`` updates them for its next call.
    brightness: gain, offset.  photometric: weight of the intensities; 0 = they are not compared.
    """

    spreads: NDArray[np.float64]
    brightness: NDArray[np.float64]
    photometric: float


class NormalEquations(NamedTuple):
    """H (8, 8), g (8,) of xi (rotation before translation, T <- exp(xi) T), gain and offset.

    statistics: counts of source pixels with a surface, of those in view, of those where the target has a surface, of
    those on it; then, for pixels with compared intensities s and t, their count and the sums of s, t, s s, t t, s t.
    """

    H: NDArray[np.float64]
    g: NDArray[np.float64]
    statistics: NDArray[np.float64]


def make_equations() -> NormalEquations:
    """Empty normal equations for ``linearize``."""
    return NormalEquations(np.zeros((_EXPOSURE, _EXPOSURE)), np.zeros(_EXPOSURE), np.zeros(STATISTICS))


@njit(nogil=True, cache=True, error_model="numpy")
def linearize(
    source: Surface,
    target: Surface,
    camera: NDArray[np.float64],
    T: NDArray[np.float64],
    stride: int,
    weighting: Weighting,
    equations: NormalEquations,
) -> None:
    """Fill the normal equations and statistics at T, the pose of the source in the target.

    camera: fx, fy, cx, cy of the full-size images; the gray images may be smaller by a power of two.  stride: step
    between the compared source pixels.
    """
    points_s, normals_s, gray_s = source.points, source.normals, source.gray
    points_t, normals_t, gray_t = target.points, target.normals, target.gray
    H, g, stats = equations.H, equations.g, equations.statistics
    scales, photometric = weighting.spreads, weighting.photometric
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
    soft_g = 1.0 / (GEMAN_MCCLURE * scales[0]) ** 2
    soft_p = 1.0 / (GEMAN_MCCLURE * scales[1]) ** 2
    sure_g = scales[0] ** 2
    sure_p = photometric / (GRAY_SIGMA * scales[1]) ** 2
    gain, offset = weighting.brightness
    J = np.zeros(_EXPOSURE)
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
            if z < NEAREST_M:
                continue
            inverse_z = 1.0 / z
            u = fx * x * inverse_z + cx
            v = fy * y * inverse_z + cy
            if not (u >= 0.5 and v >= 0.5 and u <= wt - 1.5 and v <= ht - 1.5):
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
            sigma_t = look_up_sigma(target.sigma_m, it, jt, q2)
            sigma_s = look_up_sigma(source.sigma_m, i, j, ps2)
            variance = sigma_t * sigma_t + sigma_s * sigma_s
            k = abs(r) / math.sqrt(variance)
            if n0 * m0 + n1 * m1 + n2 * m2 < NORMALS_AGREE:
                continue
            if k * _PER_SIGMA < _BINS:
                histogram_g[int(k * _PER_SIGMA)] += 1
            count_g += 1
            weight = 1.0 / ((1.0 + k * k * soft_g) ** 2 * variance * sure_g)
            if k < ON_SURFACE * scales[0]:
                stats[3] += 1
            _fill_jacobian(J, x, y, z, n0, n1, n2)
            _add_residual(H, g, J, _POSE, weight, r)
            if k > SAME_SURFACE * scales[0] or photometric == 0.0:
                continue
            ug = (u + 0.5) * shrink - 0.5
            vg = (v + 0.5) * shrink - 0.5
            jg, ig = int(ug), int(vg)
            if ug < 0 or vg < 0 or jg >= wg - 1 or ig >= hg - 1:
                continue
            value_s = _sample_source(gray_s, i, j, shrink)
            fu, fv = ug - jg, vg - ig
            g00, g01, g10, g11 = gray_t[ig, jg], gray_t[ig, jg + 1], gray_t[ig + 1, jg], gray_t[ig + 1, jg + 1]
            value_t = (1 - fv) * ((1 - fu) * g00 + fu * g01) + fv * ((1 - fu) * g10 + fu * g11)
            gu = ((1 - fv) * (g01 - g00) + fv * (g11 - g10)) * shrink
            gv = ((1 - fu) * (g10 - g00) + fu * (g11 - g01)) * shrink
            _count_intensities(stats, value_s, value_t)
            rp = value_t - (gain * value_s + offset)
            kp = abs(rp) * (1.0 / GRAY_SIGMA)
            if kp * _PER_SIGMA < _BINS:
                histogram_p[int(kp * _PER_SIGMA)] += 1
            count_p += 1
            weight_p = sure_p / (1.0 + kp * kp * soft_p) ** 2
            d0, d1 = gu * fx * inverse_z, gv * fy * inverse_z
            d2 = -(d0 * x + d1 * y) * inverse_z
            _fill_jacobian(J, x, y, z, d0, d1, d2)
            J[6] = -value_s
            J[7] = -1.0
            _add_residual(H, g, J, _EXPOSURE, weight_p, rp)
    for a in range(_EXPOSURE):
        for b in range(a):
            H[a, b] = H[b, a]
    scales[0] = _measure_spread(histogram_g, count_g, LEAST_SPREAD[0])
    scales[1] = _measure_spread(histogram_p, count_p, LEAST_SPREAD[1])


@njit(nogil=True, cache=True, inline="always")
def _fill_jacobian(J: NDArray[np.float64], x: float, y: float, z: float, d0: float, d1: float, d2: float) -> None:
    """Derivative by xi of a residual with derivative (d0, d1, d2) by the point (x, y, z)."""
    J[0] = y * d2 - z * d1
    J[1] = z * d0 - x * d2
    J[2] = x * d1 - y * d0
    J[3] = d0
    J[4] = d1
    J[5] = d2


@njit(nogil=True, cache=True, inline="always")
def _add_residual(
    H: NDArray[np.float64], g: NDArray[np.float64], J: NDArray[np.float64], unknowns: int, weight: float, r: float
) -> None:
    """Add a residual's weight J J^T (only the upper triangle) to H, and weight J r to g."""
    for a in range(unknowns):
        wj = weight * J[a]
        g[a] += wj * r
        for b in range(a, unknowns):
            H[a, b] += wj * J[b]


@njit(nogil=True, cache=True, inline="always")
def _sample_source(gray_s: NDArray[np.float32], i: int, j: int, shrink: float) -> float:
    """The intensity at a full-size pixel, interpolated linearly in a smaller image."""
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
    return value_s


@njit(nogil=True, cache=True, inline="always")
def _count_intensities(stats: NDArray[np.float64], value_s: float, value_t: float) -> None:
    stats[4] += 1
    stats[5] += value_s
    stats[6] += value_t
    stats[7] += value_s * value_s
    stats[8] += value_t * value_t
    stats[9] += value_s * value_t


@njit(nogil=True, cache=True)
def _measure_spread(histogram: NDArray[np.int64], count: int, least: float) -> float:
    """Standard deviation from the median of absolute residuals, in units of the expected one."""
    total = 0
    for k in range(len(histogram)):
        total += histogram[k]
        if 2 * total >= count:
            return max(MAD_TO_SIGMA * (k + 0.5) / _PER_SIGMA, least)
    return MAD_TO_SIGMA * len(histogram) / _PER_SIGMA
