"""Composites splats to pixels, and gradients back, compiled: tile by tile, nearest first until the tile is opaque."""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from .rasterizers.base import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN
from .splat_projection import CONIC_A, CONIC_B, CONIC_C, GRADIENTS, LEAST, OPACITY, PIXEL_U, PIXEL_V, RED, Z

TILE = 16
"""Edge of a tile in pixels, as in the 3D Gaussian Splatting paper."""

_VALUES = 5  # composited values of a Gaussian: red, green, blue, z, 1
_DIGIT = 11  # bits per pass of the sort: three passes see all 32
_SLACK = 0.01  # pixels added to an ellipse, so that rounding cuts nothing off
_SHORT = 5  # columns: for a shorter row of a splat, finding the ends of the ellipse costs more than it saves

Array = NDArray[np.float32]


@njit(cache=True)
def sort_nearest_first(rows: NDArray[np.int64], bits: NDArray[np.uint32]) -> NDArray[np.int64]:
    """Sorts rows by the floats with the given bits. Positive floats sort like integers; ties keep their order. Three
    passes of a radix sort; np.argsort takes ten times as long."""
    for shift in (0, _DIGIT, 2 * _DIGIT):
        place = np.zeros((1 << _DIGIT) + 1, np.int64)
        for n in range(len(bits)):
            place[((bits[n] >> shift) & ((1 << _DIGIT) - 1)) + 1] += 1
        for digit in range(1 << _DIGIT):
            place[digit + 1] += place[digit]
        sorted_rows, sorted_bits = np.empty_like(rows), np.empty_like(bits)
        for n in range(len(bits)):
            digit = (bits[n] >> shift) & ((1 << _DIGIT) - 1)
            sorted_rows[place[digit]], sorted_bits[place[digit]] = rows[n], bits[n]
            place[digit] += 1
        rows, bits = sorted_rows, sorted_bits
    return rows


@njit(cache=True)
def list_by_tile(box: NDArray[np.int32], across: int, down: int) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
    """Counting sort: the splats of tile t are ``listed[start[t]:start[t + 1]]``, in their order."""
    start = np.zeros(across * down + 1, np.int64)
    for s in range(len(box)):
        for row in range(box[s, 2] // TILE, box[s, 3] // TILE + 1):
            for column in range(box[s, 0] // TILE, box[s, 1] // TILE + 1):
                start[row * across + column + 1] += 1
    for tile in range(across * down):
        start[tile + 1] += start[tile]
    place = start[:-1].copy()
    listed = np.empty(start[-1], np.int32)
    for s in range(len(box)):
        for row in range(box[s, 2] // TILE, box[s, 3] // TILE + 1):
            for column in range(box[s, 0] // TILE, box[s, 1] // TILE + 1):
                tile = row * across + column
                listed[place[tile]] = s
                place[tile] += 1
    return start, listed


@njit(parallel=True, cache=True, fastmath=True)
def composite(
    splats: Array,
    box: NDArray[np.int32],
    start: NDArray[np.int64],
    listed: NDArray[np.int32],
    width: int,
    height: int,
) -> Array:
    """(H, W, 5) sums of w_k (color, z, 1)."""
    across = (width + TILE - 1) // TILE
    out = np.zeros((height, width, _VALUES), np.float32)
    for tile in prange(len(start) - 1):
        top, left = tile // across * TILE, tile % across * TILE
        bottom, right = min(top + TILE, height) - 1, min(left + TILE, width) - 1
        before = np.ones((TILE, TILE), np.float32)  # transmittance; 0 once a pixel is done
        open_pixels = (bottom - top + 1) * (right - left + 1)
        for entry in range(start[tile], start[tile + 1]):
            s = listed[entry]
            u, v, a, b, c = (
                splats[s, PIXEL_U],
                splats[s, PIXEL_V],
                splats[s, CONIC_A],
                splats[s, CONIC_B],
                splats[s, CONIC_C],
            )
            o, least = splats[s, OPACITY], splats[s, LEAST]
            red, green, blue, z = splats[s, RED], splats[s, RED + 1], splats[s, RED + 2], splats[s, Z]
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
    """First and last column, within low … high, of a row that an ellipse reaches; never one pixel too few."""
    half = b * b * dv * dv - a * (c * dv * dv + np.float32(2) * least)
    if half <= 0:
        half = np.float32(0)
    half = math.sqrt(half) / a + np.float32(_SLACK)
    middle = u - b * dv / a
    return max(low, math.ceil(middle - half)), min(high, math.floor(middle + half))


@njit(parallel=True, cache=True, fastmath=True)
def composite_backward(
    splats: Array,
    box: NDArray[np.int32],
    start: NDArray[np.int64],
    listed: NDArray[np.int32],
    out: Array,
    gradient: Array,
    threads: int,
) -> Array:
    """(threads, S, 10) partial gradients of S splats.

    With v_k = dL/dw_k and S_k = sum_{j>k} w_j v_j, dL/dalpha_k = T_k v_k - S_k / (1 - alpha_k). S_k is the rest of the
    pixel's sum, which the forward pass gave."""
    height, width = out.shape[:2]
    across = (width + TILE - 1) // TILE
    parts = np.zeros((threads, len(splats), GRADIENTS), np.float32)
    for thread in prange(threads):
        before = np.empty((TILE, TILE), np.float32)
        left_over = np.empty((TILE, TILE), np.float32)
        mine = parts[thread]
        for tile in range(thread, len(start) - 1, threads):
            top, left = tile // across * TILE, tile % across * TILE
            bottom, right = min(top + TILE, height) - 1, min(left + TILE, width) - 1
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
                u, v, a, b, c = (
                    splats[s, PIXEL_U],
                    splats[s, PIXEL_V],
                    splats[s, CONIC_A],
                    splats[s, CONIC_B],
                    splats[s, CONIC_C],
                )
                o, least = splats[s, OPACITY], splats[s, LEAST]
                red, green, blue, z = splats[s, RED], splats[s, RED + 1], splats[s, RED + 2], splats[s, Z]
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
                for i in range(GRADIENTS):
                    mine[s, i] += found[i]
                if open_pixels == 0:
                    break
    return parts
