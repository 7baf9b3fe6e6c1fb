"""Compiled for CPUs: tiles, sorted splats, forward and backward on all cores."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from numba import get_num_threads, njit, prange
from numpy.typing import NDArray
from torch import Tensor

from ...core.types import Intrinsics
from .base import ALPHA_MAX, ALPHA_MIN, BLUR, NEAR, TRANSMITTANCE_MIN, Rendered, compute_slope_limits

REQUIRES: tuple[str, ...] = ()

_TILE = 16
_PIXELS = _TILE * _TILE
_VALUES = 5  # of a Gaussian that are composited: red, green, blue, z, 1
_SHORT = 5  # columns: a shorter row of a splat is not worth the search for the ellipse's ends
_LOG_ALPHA_MIN = math.log(ALPHA_MIN)

# Columns of a splat: pixel, conic (a, b, c), opacity, smallest exponent that reaches ALPHA_MIN, values without the 1.
_U, _V, _A, _B, _C, _O, _LEAST, _RED, _Z = 0, 1, 2, 3, 4, 5, 6, 7, 10
_COLUMNS = 11
# Columns of its gradient: pixel, conic, opacity, colour, z.
_GRADIENTS = 10

Array = NDArray[np.float32]


class CpuRasterizer:
    """Splats are sorted by depth once, then listed by the tiles that they reach; a tile is composited nearest first
    until it is opaque. The backward pass composites again, and each thread adds up gradients of its own.

    Memory: 44 bytes a splat in view, 4 a splat and tile, and backward 40 a splat and thread."""

    def __init__(self) -> None:
        self.device = torch.device("cpu")

    def render(
        self,
        means: Tensor,
        scales: Tensor,
        quats_wxyz: Tensor,
        opacities: Tensor,
        colors: Tensor,
        T_cam_world: Tensor,
        camera: Intrinsics,
    ) -> Rendered:
        """See ``base.Rasterizer``."""
        out = _Render.apply(means, scales, quats_wxyz, opacities, colors, T_cam_world, camera)
        return Rendered(out[..., :3], out[..., 3], out[..., 4])


class _Render(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *arguments: Any) -> Tensor:
        means, scales, quats, opacities, colors = (_array(tensor) for tensor in arguments[:5])
        T, camera = _array(arguments[5]), arguments[6]
        pinhole = np.array((camera.fx, camera.fy, camera.cx, camera.cy), np.float32)
        limits = np.array(compute_slope_limits(camera), np.float32)
        splats, box = _project(means, scales, quats, opacities, colors, T, pinhole, limits, camera.width, camera.height)
        rows = np.flatnonzero(box[:, 0] <= box[:, 1])
        rows = _nearest_first(rows, splats[rows, _Z].view(np.uint32))
        splats, box = splats[rows], box[rows]
        start, listed = _list_by_tile(box, -(-camera.width // _TILE), -(-camera.height // _TILE))
        out = _composite(splats, box, start, listed, camera.width, camera.height)
        ctx.saved = (means, scales, quats, T, pinhole, limits, rows, splats, box, start, listed, out)
        return torch.from_numpy(out)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        means, scales, quats, T, pinhole, limits, rows, splats, box, start, listed, out = ctx.saved
        parts = _composite_backward(splats, box, start, listed, out, _array(gradient), get_num_threads())
        found = _project_backward(means, scales, quats, T, pinhole, limits, rows, parts)
        return *(torch.from_numpy(array) for array in found), None, None


def _array(tensor: Tensor) -> Array:
    return np.ascontiguousarray(tensor.detach().numpy(), np.float32)


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
def _project(
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
    """(N, 11) splats, and (N, 4) first and last column, first and last row that they reach; first > last: none."""
    n = len(means)
    splats = np.empty((n, _COLUMNS), np.float32)
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
        # A bound of the extent that needs no rotation leaves most of what is out of view.
        largest = max(scales[g, 0], scales[g, 1], scales[g, 2])
        bound = reach * (math.sqrt(np.float32(BLUR)) + largest * (fx + fy) * np.float32(1.5) / z)
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
        box[g, 0], box[g, 1] = max(math.ceil(u - u_reach), 0), min(math.floor(u + u_reach), width - 1)
        box[g, 2], box[g, 3] = max(math.ceil(v - v_reach), 0), min(math.floor(v + v_reach), height - 1)
        if box[g, 2] > box[g, 3]:
            box[g, 0], box[g, 1] = 1, 0
            continue
        splats[g, _U], splats[g, _V] = u, v
        splats[g, _A], splats[g, _B], splats[g, _C] = vv / determinant, -uv / determinant, uu / determinant
        splats[g, _O], splats[g, _LEAST] = opacities[g], least
        for i in range(3):
            splats[g, _RED + i] = colors[g, i]
        splats[g, _Z] = z
    return splats, box


@njit(cache=True)
def _nearest_first(rows: NDArray[np.int64], bits: NDArray[np.uint32]) -> NDArray[np.int64]:
    """Rows sorted by the floats whose bits are given, which sort as integers do, being positive; ties as they come.
    Three passes of a radix sort: np.argsort takes ten times as long."""
    for shift in (0, 11, 22):
        place = np.zeros(2049, np.int64)
        for n in range(len(bits)):
            place[((bits[n] >> shift) & 2047) + 1] += 1
        for digit in range(2048):
            place[digit + 1] += place[digit]
        sorted_rows, sorted_bits = np.empty_like(rows), np.empty_like(bits)
        for n in range(len(bits)):
            digit = (bits[n] >> shift) & 2047
            sorted_rows[place[digit]], sorted_bits[place[digit]] = rows[n], bits[n]
            place[digit] += 1
        rows, bits = sorted_rows, sorted_bits
    return rows


@njit(cache=True)
def _list_by_tile(box: NDArray[np.int32], across: int, down: int) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
    """Counting sort: tile t's splats are ``listed[start[t]:start[t + 1]]``, in their order."""
    start = np.zeros(across * down + 1, np.int64)
    for s in range(len(box)):
        for row in range(box[s, 2] // _TILE, box[s, 3] // _TILE + 1):
            for column in range(box[s, 0] // _TILE, box[s, 1] // _TILE + 1):
                start[row * across + column + 1] += 1
    for tile in range(across * down):
        start[tile + 1] += start[tile]
    place = start[:-1].copy()
    listed = np.empty(start[-1], np.int32)
    for s in range(len(box)):
        for row in range(box[s, 2] // _TILE, box[s, 3] // _TILE + 1):
            for column in range(box[s, 0] // _TILE, box[s, 1] // _TILE + 1):
                tile = row * across + column
                listed[place[tile]] = s
                place[tile] += 1
    return start, listed


@njit(parallel=True, cache=True, fastmath=True)
def _composite(
    splats: Array,
    box: NDArray[np.int32],
    start: NDArray[np.int64],
    listed: NDArray[np.int32],
    width: int,
    height: int,
) -> Array:
    """(H, W, 5) sums of w_k (colour, z, 1)."""
    across = (width + _TILE - 1) // _TILE
    out = np.zeros((height, width, _VALUES), np.float32)
    for tile in prange(len(start) - 1):
        top, left = tile // across * _TILE, tile % across * _TILE
        bottom, right = min(top + _TILE, height) - 1, min(left + _TILE, width) - 1
        before = np.ones((_TILE, _TILE), np.float32)  # transmittance; 0 once a pixel is done
        open_pixels = (bottom - top + 1) * (right - left + 1)
        for entry in range(start[tile], start[tile + 1]):
            s = listed[entry]
            u, v, a, b, c = splats[s, _U], splats[s, _V], splats[s, _A], splats[s, _B], splats[s, _C]
            o, least = splats[s, _O], splats[s, _LEAST]
            red, green, blue, z = splats[s, _RED], splats[s, _RED + 1], splats[s, _RED + 2], splats[s, _Z]
            first_of_box, last_of_box = max(box[s, 0], left), min(box[s, 1], right)
            for row in range(max(box[s, 2], top), min(box[s, 3], bottom) + 1):
                dv = row - v
                first, last = first_of_box, last_of_box
                if last - first > _SHORT:
                    first, last = _span(u, dv, a, b, c, least, first, last)
                for column in range(first, last + 1):
                    T = before[row - top, column - left]
                    if T == 0:
                        continue
                    du = column - u
                    exponent = np.float32(-0.5) * (a * du * du + c * dv * dv) - b * du * dv
                    alpha = min(np.float32(ALPHA_MAX), o * math.exp(exponent))
                    if alpha < np.float32(ALPHA_MIN):
                        continue
                    after = T * (np.float32(1) - alpha)
                    if after <= np.float32(TRANSMITTANCE_MIN):
                        before[row - top, column - left] = 0
                        open_pixels -= 1
                        continue
                    before[row - top, column - left] = after
                    w = alpha * T
                    out[row, column, 0] += w * red
                    out[row, column, 1] += w * green
                    out[row, column, 2] += w * blue
                    out[row, column, 3] += w * z
                    out[row, column, 4] += w
            if open_pixels == 0:
                break
    return out


@njit(cache=True, fastmath=True)
def _span(
    u: np.float32,
    dv: np.float32,
    a: np.float32,
    b: np.float32,
    c: np.float32,
    least: np.float32,
    low: int,
    high: int,
) -> tuple[int, int]:
    """First and last column of a row that an ellipse reaches, within low … high, and not one pixel too few."""
    half = b * b * dv * dv - a * (c * dv * dv + np.float32(2) * least)
    if half <= 0:
        half = np.float32(0)
    half = math.sqrt(half) / a + np.float32(0.01)
    middle = u - b * dv / a
    return max(low, math.ceil(middle - half)), min(high, math.floor(middle + half))


@njit(parallel=True, cache=True, fastmath=True)
def _composite_backward(
    splats: Array,
    box: NDArray[np.int32],
    start: NDArray[np.int64],
    listed: NDArray[np.int32],
    out: Array,
    gradient: Array,
    threads: int,
) -> Array:
    """(threads, S, 10) parts of the gradients of S splats.

    With v_k = dL/dw_k and S_k = sum_{j>k} w_j v_j, dL/dalpha_k = T_k v_k - S_k / (1 - alpha_k); S_k is what is left of
    the pixel's sum, which the forward pass gave."""
    height, width = out.shape[:2]
    across = (width + _TILE - 1) // _TILE
    parts = np.zeros((threads, len(splats), _GRADIENTS), np.float32)
    for thread in prange(threads):
        before = np.empty((_TILE, _TILE), np.float32)
        left_over = np.empty((_TILE, _TILE), np.float32)
        mine = parts[thread]
        for tile in range(thread, len(start) - 1, threads):
            top, left = tile // across * _TILE, tile % across * _TILE
            bottom, right = min(top + _TILE, height) - 1, min(left + _TILE, width) - 1
            before[:] = 1
            for row in range(top, bottom + 1):
                for column in range(left, right + 1):
                    total = np.float32(0)
                    for i in range(_VALUES):
                        total += out[row, column, i] * gradient[row, column, i]
                    left_over[row - top, column - left] = total
            open_pixels = (bottom - top + 1) * (right - left + 1)
            for entry in range(start[tile], start[tile + 1]):
                s = listed[entry]
                u, v, a, b, c = splats[s, _U], splats[s, _V], splats[s, _A], splats[s, _B], splats[s, _C]
                o, least = splats[s, _O], splats[s, _LEAST]
                red, green, blue, z = splats[s, _RED], splats[s, _RED + 1], splats[s, _RED + 2], splats[s, _Z]
                d_u = d_v = d_a = d_b = d_c = d_o = d_red = d_green = d_blue = d_z = np.float32(0)
                first_of_box, last_of_box = max(box[s, 0], left), min(box[s, 1], right)
                for row in range(max(box[s, 2], top), min(box[s, 3], bottom) + 1):
                    dv = row - v
                    first, last = first_of_box, last_of_box
                    if last - first > _SHORT:
                        first, last = _span(u, dv, a, b, c, least, first, last)
                    for column in range(first, last + 1):
                        T = before[row - top, column - left]
                        if T == 0:
                            continue
                        du = column - u
                        exponent = np.float32(-0.5) * (a * du * du + c * dv * dv) - b * du * dv
                        falloff = math.exp(exponent)
                        alpha = min(np.float32(ALPHA_MAX), o * falloff)
                        if alpha < np.float32(ALPHA_MIN):
                            continue
                        after = T * (np.float32(1) - alpha)
                        if after <= np.float32(TRANSMITTANCE_MIN):
                            before[row - top, column - left] = 0
                            open_pixels -= 1
                            continue
                        before[row - top, column - left] = after
                        w = alpha * T
                        g_red, g_green = gradient[row, column, 0], gradient[row, column, 1]
                        g_blue, g_z = gradient[row, column, 2], gradient[row, column, 3]
                        value = red * g_red + green * g_green + blue * g_blue + z * g_z + gradient[row, column, 4]
                        left_over[row - top, column - left] -= w * value
                        d_red += w * g_red
                        d_green += w * g_green
                        d_blue += w * g_blue
                        d_z += w * g_z
                        if o * falloff > np.float32(ALPHA_MAX):
                            continue
                        d_alpha = T * value - left_over[row - top, column - left] / (np.float32(1) - alpha)
                        d_o += falloff * d_alpha
                        d_exponent = alpha * d_alpha
                        d_u += d_exponent * (a * du + b * dv)
                        d_v += d_exponent * (b * du + c * dv)
                        d_a -= d_exponent * np.float32(0.5) * du * du
                        d_b -= d_exponent * du * dv
                        d_c -= d_exponent * np.float32(0.5) * dv * dv
                found = (d_u, d_v, d_a, d_b, d_c, d_o, d_red, d_green, d_blue, d_z)
                for i in range(_GRADIENTS):
                    mine[s, i] += found[i]
                if open_pixels == 0:
                    break
    return parts


@njit(parallel=True, cache=True)
def _project_backward(
    means: Array,
    scales: Array,
    quats: Array,
    T: Array,
    pinhole: Array,
    limits: Array,
    rows: NDArray[np.int64],
    parts: Array,
) -> tuple[Array, Array, Array, Array, Array]:
    """Gradients of means, scales, quaternions, opacities, colours from those of the splats, which are rows of the
    Gaussians."""
    n = len(means)
    d_means, d_scales = np.zeros((n, 3), np.float32), np.zeros((n, 3), np.float32)
    d_quats, d_opacities = np.zeros((n, 4), np.float32), np.zeros(n, np.float32)
    d_colors = np.zeros((n, 3), np.float32)
    fx, fy = pinhole[0], pinhole[1]
    for thread in prange(len(parts)):
        _part_backward(
            thread,
            means,
            scales,
            quats,
            T,
            limits,
            fx,
            fy,
            rows,
            parts,
            d_means,
            d_scales,
            d_quats,
            d_opacities,
            d_colors,
        )
    return d_means, d_scales, d_quats, d_opacities, d_colors


@njit(cache=True)
def _part_backward(
    thread: int,
    means: Array,
    scales: Array,
    quats: Array,
    T: Array,
    limits: Array,
    fx: np.float32,
    fy: np.float32,
    rows: NDArray[np.int64],
    parts: Array,
    d_means: Array,
    d_scales: Array,
    d_quats: Array,
    d_opacities: Array,
    d_colors: Array,
) -> None:
    """A thread's share of ``_project_backward``: every n-th splat."""
    d = np.empty(_GRADIENTS, np.float32)
    M = np.empty((2, 3), np.float32)
    C = np.empty((3, 3), np.float32)  # R Q: the principal axes in the camera's frame
    D = np.empty((3, 3), np.float32)  # dL/d(Q S)
    for s in range(thread, len(rows), len(parts)):
        g = rows[s]
        d[:] = parts[0, s]
        for other in range(1, len(parts)):
            d += parts[other, s]
        d_opacities[g] = d[5]
        for i in range(3):
            d_colors[g, i] = d[6 + i]
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
        # dL/dSigma = -K (dL/dK) K with K = Sigma^-1 and the off-diagonal gradient, of both entries, halved.
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
        along = dw * qw + dx * qx + dy * qy + dz * qz  # what lengthens the quaternion changes nothing
        d_quats[g, 0], d_quats[g, 1] = (dw - along * qw) / norm, (dx - along * qx) / norm
        d_quats[g, 2], d_quats[g, 3] = (dy - along * qy) / norm, (dz - along * qz) / norm
        # The mean moves the pixel, z, and J through 1 / z and the slopes (only while they are within their limits).
        cam_x = d[0] * fx / z
        cam_y = d[1] * fy / z
        cam_z = d[9] - (d[0] * fx * x + d[1] * fy * y) / (z * z) - d_fz / (z * z)
        if x / z == a:
            cam_x += d_a / z
            cam_z -= d_a * x / (z * z)
        if y / z == b:
            cam_y += d_b / z
            cam_z -= d_b * y / (z * z)
        for i in range(3):
            d_means[g, i] = T[0, i] * cam_x + T[1, i] * cam_y + T[2, i] * cam_z


def load() -> CpuRasterizer:
    """The rasterizer."""
    return CpuRasterizer()
