"""Composites splats to pixels, and gradients back, compiled: tile by tile, nearest first until the tile is opaque.

With e2, e1, e0 of a row of pixels, the exponent is -1/2 (a du^2 + 2 b du dv + c dv^2) = (e2 du + e1) du + e0.
"""

from __future__ import annotations

import math

import numpy as np
from numba import prange
from numpy.typing import NDArray

from ..core.compiling import njit
from .rasterizers.base import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN
from .splat_projection import CONIC_A, CONIC_B, CONIC_C, DEALT, GRADIENTS, LEAST, OPACITY, PIXEL_U, PIXEL_V, RED, Z

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
def list_by_tile(
    box: NDArray[np.int32], across: int, down: int
) -> tuple[NDArray[np.int64], NDArray[np.int32], NDArray[np.int64], NDArray[np.int32]]:
    """Counting sort. The splats of tile t are ``listed[start[t]:start[t + 1]]``, in their order; splat s is at
    ``places[first[s]:first[s + 1]]`` of ``listed``, in the order of its tiles."""
    start = np.zeros(across * down + 1, np.int64)
    for s in range(len(box)):
        for row in range(box[s, 2] // TILE, box[s, 3] // TILE + 1):
            for column in range(box[s, 0] // TILE, box[s, 1] // TILE + 1):
                start[row * across + column + 1] += 1
    for tile in range(across * down):
        start[tile + 1] += start[tile]
    place = start[:-1].copy()
    listed, places = np.empty(start[-1], np.int32), np.empty(start[-1], np.int32)
    first = np.zeros(len(box) + 1, np.int64)
    n = 0
    for s in range(len(box)):
        for row in range(box[s, 2] // TILE, box[s, 3] // TILE + 1):
            for column in range(box[s, 0] // TILE, box[s, 1] // TILE + 1):
                tile = row * across + column
                listed[place[tile]], places[n] = s, place[tile]
                place[tile] += 1
                n += 1
        first[s + 1] = n
    return start, listed, first, places


@njit(parallel=True, cache=True, error_model="numpy")
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
                dv = np.float32(row) - v
                first, last = first_of_box, last_of_box
                if last - first > _SHORT:
                    first, last = _span(u, dv, a, b, c, least, first, last)
                e2, e1, e0 = np.float32(-0.5) * a, -b * dv, np.float32(-0.5) * c * dv * dv
                for column in range(first, last + 1):
                    T = before[row - top, column - left]
                    if T == 0:
                        continue
                    du = np.float32(column) - u
                    alpha = min(np.float32(ALPHA_MAX), o * math.exp((e2 * du + e1) * du + e0))
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


@njit(cache=True, error_model="numpy")
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
    half = max(b * b * dv * dv - a * (c * dv * dv + np.float32(2) * least), np.float32(0))
    half = math.sqrt(half) / a + np.float32(_SLACK)
    middle = u - b * dv / a
    lowest, highest = np.float32(low), np.float32(high)  # before the cast: it is undefined for what no integer holds
    first = math.ceil(min(max(middle - half, lowest), highest + np.float32(1)))
    return max(low, first), min(high, math.floor(max(min(middle + half, highest), lowest - np.float32(1))))


@njit(parallel=True, cache=True, error_model="numpy")
def composite_backward(
    splats: Array,
    box: NDArray[np.int32],
    start: NDArray[np.int64],
    listed: NDArray[np.int32],
    out: Array,
    gradient: Array,
) -> Array:
    """(P, 10) gradients of the P ``listed`` splats, each of what its tile shows. The caller sums a splat's gradients in
    the order of its tiles, so that the sum does not depend on the number of threads.

    With v_k = dL/dw_k and S_k = sum_{j>k} w_j v_j, dL/dalpha_k = T_k v_k - S_k / (1 - alpha_k). S_k is the rest of the
    pixel's sum, which the forward pass gave."""
    height, width = out.shape[:2]
    across = (width + TILE - 1) // TILE
    found = np.zeros((len(listed), GRADIENTS), np.float32)
    for share in prange(DEALT):
        before = np.empty((TILE, TILE), np.float32)
        left_over = np.empty((TILE, TILE), np.float32)
        for tile in range(share, len(start) - 1, DEALT):
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
                # Sums over the pixels of dL/d(exponent) times powers of du and dv, and the other gradients.
                sum_u = sum_v = sum_uu = sum_uv = sum_vv = np.float32(0)
                d_o = d_red = d_green = d_blue = d_z = np.float32(0)
                first_of_box, last_of_box = max(box[s, 0], left), min(box[s, 1], right)
                for row in range(max(box[s, 2], top), min(box[s, 3], bottom) + 1):
                    dv = np.float32(row) - v
                    first, last = first_of_box, last_of_box
                    if last - first > _SHORT:
                        first, last = _span(u, dv, a, b, c, least, first, last)
                    e2, e1, e0 = np.float32(-0.5) * a, -b * dv, np.float32(-0.5) * c * dv * dv
                    row_1 = row_u = np.float32(0)
                    for column in range(first, last + 1):
                        T = before[row - top, column - left]
                        if T == 0:
                            continue
                        du = np.float32(column) - u
                        falloff = math.exp((e2 * du + e1) * du + e0)
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
                        row_1 += d_exponent
                        row_u += d_exponent * du
                        sum_uu += d_exponent * du * du
                    sum_u += row_u
                    sum_v += row_1 * dv
                    sum_uv += row_u * dv
                    sum_vv += row_1 * dv * dv
                own = found[entry]
                own[PIXEL_U], own[PIXEL_V] = a * sum_u + b * sum_v, b * sum_u + c * sum_v
                own[CONIC_A], own[CONIC_B], own[CONIC_C] = np.float32(-0.5) * sum_uu, -sum_uv, np.float32(-0.5) * sum_vv
                own[5], own[6], own[7], own[8], own[9] = d_o, d_red, d_green, d_blue, d_z
                if open_pixels == 0:
                    break
    return found
