"""Projects Gaussians to splats in an image, and gradients back, compiled (equations: ``rasterizers/base.py``).

A splat is a row of numbers: its pixel u, v; its conic a, b, c, the inverse of Sigma_2; opacity; color; z. Its gradient
is a row of the same columns.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import prange
from numpy.typing import NDArray

from ..core.compiling import njit
from .rasterizers.base import ALPHA_MIN, BLUR, NEAR

PIXEL_U, PIXEL_V, CONIC_A, CONIC_B, CONIC_C, OPACITY, RED, Z = 0, 1, 2, 3, 4, 5, 6, 9
"""Columns of a splat; green and blue follow red."""

COLUMNS = 10
"""Number of columns of a splat."""

DEALT = 64
"""Tiles and splats are dealt to so many loops, whatever the number of threads: neighbors take equally long."""

_LOG_ALPHA_MIN = math.log(ALPHA_MIN)
_STEEPEST = 1.5  # |J| <= this (fx + fy) / z while |x / z| and |y / z| are below 1: sqrt(2) rounded up

Array = NDArray[np.float32]


@njit(cache=True)
def _unit_rotation(
    w: np.float32, x: np.float32, y: np.float32, z: np.float32
) -> tuple[tuple[Any, ...], tuple[Any, ...], tuple[Any, ...]]:
    one, two = np.float32(1), np.float32(2)
    return (
        (one - two * (y * y + z * z), two * (x * y - w * z), two * (x * z + w * y)),
        (two * (x * y + w * z), one - two * (x * x + z * z), two * (y * z - w * x)),
        (two * (x * z - w * y), two * (y * z + w * x), one - two * (x * x + y * y)),
    )


@njit(parallel=True, cache=True)
def project_splats(
    means: Array,
    scales: Array,
    quats: Array,
    opacities: Array,
    colors: Array,
    T: Array,
    pinhole: Array,
    limits: Array,
    width: int,
    height: int,
) -> tuple[Array, NDArray[np.int32]]:
    """(N, 10) splats, and (N, 4) the first and last column and the first and last row that each reaches; first > last:
    none."""
    n = len(means)
    splats = np.empty((n, COLUMNS), np.float32)
    box = np.empty((n, 4), np.int32)
    fx, fy, cx, cy = pinhole[0], pinhole[1], pinhole[2], pinhole[3]
    for g in prange(n):
        box[g, 0], box[g, 1] = 1, 0
        z = T[2, 0] * means[g, 0] + T[2, 1] * means[g, 1] + T[2, 2] * means[g, 2] + T[2, 3]
        if not z > NEAR or not opacities[g] >= ALPHA_MIN:
            continue
        x = T[0, 0] * means[g, 0] + T[0, 1] * means[g, 1] + T[0, 2] * means[g, 2] + T[0, 3]
        y = T[1, 0] * means[g, 0] + T[1, 1] * means[g, 1] + T[1, 2] * means[g, 2] + T[1, 3]
        u, v = fx * x / z + cx, fy * y / z + cy
        least = np.float32(_LOG_ALPHA_MIN) - math.log(opacities[g])
        reach = math.sqrt(np.float32(-2) * least)
        # A bound on the extent that needs no rotation skips most Gaussians out of view.
        largest = max(scales[g, 0], scales[g, 1], scales[g, 2])
        bound = reach * (math.sqrt(np.float32(BLUR)) + largest * (fx + fy) * np.float32(_STEEPEST) / z)
        outside = u < -bound or v < -bound or u > width - 1 + bound or v > height - 1 + bound
        if outside and abs(x / z) < 1 and abs(y / z) < 1:  # where the bound holds: |J| <= 1.5 (fx + fy) / z
            continue
        a = min(max(x / z, limits[0]), limits[1])
        b = min(max(y / z, limits[2]), limits[3])
        norm = math.sqrt(quats[g, 0] ** 2 + quats[g, 1] ** 2 + quats[g, 2] ** 2 + quats[g, 3] ** 2)
        Q = _unit_rotation(quats[g, 0] / norm, quats[g, 1] / norm, quats[g, 2] / norm, quats[g, 3] / norm)
        uu = vv = np.float32(BLUR)
        uv = np.float32(0)
        for j in range(3):
            p = T[0, 0] * Q[0][j] + T[0, 1] * Q[1][j] + T[0, 2] * Q[2][j]
            q = T[1, 0] * Q[0][j] + T[1, 1] * Q[1][j] + T[1, 2] * Q[2][j]
            r = T[2, 0] * Q[0][j] + T[2, 1] * Q[1][j] + T[2, 2] * Q[2][j]
            m0 = fx / z * (p - a * r) * scales[g, j]
            m1 = fy / z * (q - b * r) * scales[g, j]
            uu += m0 * m0
            uv += m0 * m1
            vv += m1 * m1
        determinant = uu * vv - uv * uv
        if not determinant > 0:
            continue
        u_reach, v_reach = reach * math.sqrt(uu), reach * math.sqrt(vv)
        if not (u + u_reach >= 0 and v + v_reach >= 0 and u - u_reach <= width - 1 and v - v_reach <= height - 1):
            continue
        box[g, 0], box[g, 1] = math.ceil(max(u - u_reach, 0)), math.floor(min(u + u_reach, width - 1))
        box[g, 2], box[g, 3] = math.ceil(max(v - v_reach, 0)), math.floor(min(v + v_reach, height - 1))
        if box[g, 2] > box[g, 3]:
            box[g, 0], box[g, 1] = 1, 0
            continue
        splats[g, PIXEL_U], splats[g, PIXEL_V] = u, v
        splats[g, CONIC_A], splats[g, CONIC_B], splats[g, CONIC_C] = (
            vv / determinant,
            -uv / determinant,
            uu / determinant,
        )
        splats[g, OPACITY] = opacities[g]
        for i in range(3):
            splats[g, RED + i] = colors[g, i]
        splats[g, Z] = z
    return splats, box


@njit(parallel=True, cache=True)
def project_backward(
    means: Array,
    scales: Array,
    quats: Array,
    T: Array,
    pinhole: Array,
    limits: Array,
    rows: NDArray[np.int64],
    by_tile: Array,
    first: NDArray[np.int64],
    places: NDArray[np.int32],
) -> tuple[Array, Array, Array, Array, Array]:
    """Gradients of means, scales, quaternions, opacities and colors. rows: the Gaussian of each splat.  by_tile: (P,
    10) gradients of the splats; splat s has those at ``places[first[s]:first[s + 1]]``."""
    n = len(means)
    d_means, d_scales = np.zeros((n, 3), np.float32), np.zeros((n, 3), np.float32)
    d_quats, d_opacities = np.zeros((n, 4), np.float32), np.zeros(n, np.float32)
    d_colors = np.zeros((n, 3), np.float32)
    fx, fy = pinhole[0], pinhole[1]
    for share in prange(DEALT):
        _share_backward(
            np.int64(share),  # of the same type in every thread, or the function is compiled twice
            means,
            scales,
            quats,
            T,
            limits,
            fx,
            fy,
            rows,
            by_tile,
            first,
            places,
            d_means,
            d_scales,
            d_quats,
            d_opacities,
            d_colors,
        )
    return d_means, d_scales, d_quats, d_opacities, d_colors


@njit(cache=True)
def _share_backward(
    share: int,
    means: Array,
    scales: Array,
    quats: Array,
    T: Array,
    limits: Array,
    fx: np.float32,
    fy: np.float32,
    rows: NDArray[np.int64],
    by_tile: Array,
    first: NDArray[np.int64],
    places: NDArray[np.int32],
    d_means: Array,
    d_scales: Array,
    d_quats: Array,
    d_opacities: Array,
    d_colors: Array,
) -> None:
    """A share of ``project_backward``: every n-th splat."""
    d = np.empty(COLUMNS, np.float32)
    M = np.empty((2, 3), np.float32)
    C = np.empty((3, 3), np.float32)  # R Q: the principal axes in the camera's frame
    D = np.empty((3, 3), np.float32)  # dL/d(Q S)
    for s in range(share, len(rows), DEALT):
        g = rows[s]
        d[:] = 0
        for place in places[first[s] : first[s + 1]]:
            for i in range(COLUMNS):
                d[i] += by_tile[place, i]
        d_opacities[g] = d[OPACITY]
        for i in range(3):
            d_colors[g, i] = d[RED + i]
        x = T[0, 0] * means[g, 0] + T[0, 1] * means[g, 1] + T[0, 2] * means[g, 2] + T[0, 3]
        y = T[1, 0] * means[g, 0] + T[1, 1] * means[g, 1] + T[1, 2] * means[g, 2] + T[1, 3]
        z = T[2, 0] * means[g, 0] + T[2, 1] * means[g, 1] + T[2, 2] * means[g, 2] + T[2, 3]
        a = min(max(x / z, limits[0]), limits[1])
        b = min(max(y / z, limits[2]), limits[3])
        norm = math.sqrt(quats[g, 0] ** 2 + quats[g, 1] ** 2 + quats[g, 2] ** 2 + quats[g, 3] ** 2)
        qw, qx, qy, qz = quats[g, 0] / norm, quats[g, 1] / norm, quats[g, 2] / norm, quats[g, 3] / norm
        Q = _unit_rotation(qw, qx, qy, qz)
        uu = vv = np.float32(BLUR)
        uv = np.float32(0)
        for j in range(3):
            for i in range(3):
                C[i, j] = T[i, 0] * Q[0][j] + T[i, 1] * Q[1][j] + T[i, 2] * Q[2][j]
            M[0, j] = fx / z * (C[0, j] - a * C[2, j]) * scales[g, j]
            M[1, j] = fy / z * (C[1, j] - b * C[2, j]) * scales[g, j]
            uu += M[0, j] * M[0, j]
            uv += M[0, j] * M[1, j]
            vv += M[1, j] * M[1, j]
        determinant = uu * vv - uv * uv
        ka, kb, kc = vv / determinant, -uv / determinant, uu / determinant
        # dL/dSigma = -K (dL/dK) K with K = Sigma^-1; the off-diagonal gradient, which covers both entries, is halved.
        ga, gb, gc = d[2], np.float32(0.5) * d[3], d[4]
        e00, e01 = ga * ka + gb * kb, ga * kb + gb * kc
        e10, e11 = gb * ka + gc * kb, gb * kb + gc * kc
        s00 = -(ka * e00 + kb * e10)
        s01 = -(ka * e01 + kb * e11)
        s11 = -(kb * e01 + kc * e11)
        d_fz = np.float32(0)  # of 1 / z in J
        d_a = d_b = np.float32(0)
        for j in range(3):
            m0 = np.float32(2) * (s00 * M[0, j] + s01 * M[1, j])  # dL/dM = 2 dL/dSigma M
            m1 = np.float32(2) * (s01 * M[0, j] + s11 * M[1, j])
            d_fz += z * (m0 * M[0, j] + m1 * M[1, j])
            d_a -= m0 * fx / z * C[2, j] * scales[g, j]
            d_b -= m1 * fy / z * C[2, j] * scales[g, j]
            c0, c1 = m0 * fx / z, m1 * fy / z
            c2 = -(a * c0 + b * c1)
            for i in range(3):
                D[i, j] = T[0, i] * c0 + T[1, i] * c1 + T[2, i] * c2
            d_scales[g, j] = D[0, j] * Q[0][j] + D[1, j] * Q[1][j] + D[2, j] * Q[2][j]
        for i in range(3):
            for j in range(3):
                D[i, j] *= scales[g, j]
        two = np.float32(2)
        dw = two * (qx * (D[2, 1] - D[1, 2]) + qy * (D[0, 2] - D[2, 0]) + qz * (D[1, 0] - D[0, 1]))
        dx = two * (
            qy * (D[0, 1] + D[1, 0])
            + qz * (D[0, 2] + D[2, 0])
            + qw * (D[2, 1] - D[1, 2])
            - two * qx * (D[1, 1] + D[2, 2])
        )
        dy = two * (
            qx * (D[0, 1] + D[1, 0])
            + qz * (D[1, 2] + D[2, 1])
            + qw * (D[0, 2] - D[2, 0])
            - two * qy * (D[0, 0] + D[2, 2])
        )
        dz = two * (
            qx * (D[0, 2] + D[2, 0])
            + qy * (D[1, 2] + D[2, 1])
            + qw * (D[1, 0] - D[0, 1])
            - two * qz * (D[0, 0] + D[1, 1])
        )
        along = dw * qw + dx * qx + dy * qy + dz * qz  # the length of the quaternion has no effect
        d_quats[g, 0], d_quats[g, 1] = (dw - along * qw) / norm, (dx - along * qx) / norm
        d_quats[g, 2], d_quats[g, 3] = (dy - along * qy) / norm, (dz - along * qz) / norm
        # The mean moves the pixel, z, and J through 1 / z and through the slopes (only while they are within their
        # limits).
        cam_x = d[0] * fx / z
        cam_y = d[1] * fy / z
        cam_z = d[Z] - (d[0] * fx * x + d[1] * fy * y) / (z * z) - d_fz / (z * z)
        if x / z == a:
            cam_x += d_a / z
            cam_z -= d_a * x / (z * z)
        if y / z == b:
            cam_y += d_b / z
            cam_z -= d_b * y / (z * z)
        for i in range(3):
            d_means[g, i] = T[0, i] * cam_x + T[1, i] * cam_y + T[2, i] * cam_z
