"""Composites splats to pixels, and gradients back, compiled: tile by tile, nearest first until the tile is opaque.

With e2, e1, e0 of a row of pixels, the exponent is -1/2 (a du^2 + 2 b du dv + c dv^2) = (e2 du + e1) du + e0.

A tile is kept as planes of one float32 array: plane k, pixel p is at k PIXELS + p. A splat changes whole rows of a tile
by arithmetic without branches; pixels that it does not reach get weight 0. Compilers then compute eight pixels at once.
"""

from __future__ import annotations

import numpy as np
from numba import prange
from numpy.typing import NDArray

from ..core.compiling import njit
from .rasterizers.base import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN
from .splat_projection import COLUMNS, CONIC_A, CONIC_B, CONIC_C, DEALT, OPACITY, PIXEL_U, PIXEL_V, RED, Z

TILE = 16
"""Edge of a tile in pixels, as in the 3D Gaussian Splatting paper."""

_PIXELS = TILE * TILE
_VALUES = 5  # composited values of a Gaussian: red, green, blue, z, 1
_DIGIT = 11  # bits per pass of the sort: three passes see all 32

_T = 0
"""Plane of the transmittance, 0 once a pixel is done; both passes have it."""
_SUMS = 1
"""First of the forward pass's planes of sums, one for each value."""
_FORWARD = _SUMS + _VALUES
_REST, _GRADIENT = 1, 2
"""The backward pass's planes: what later splats add to the loss, and the gradient by each value."""
_BY_EXPONENT, _BY_OPACITY, _WEIGHT = 7, 8, 9
"""Planes of one splat: derivatives of the loss by its exponent and opacity, and its weight w."""
_BACKWARD = 10
"""Numbers of planes of the passes. The last plane is followed by the column numbers 0 … TILE - 1."""

_SPLAT_SUMS = 8
"""Sums of a splat for each column: of dL/d(exponent) times 1, dv and dv^2; the gradients by o, color and z."""

_FAINT = -6.0
"""An exponent below it is taken for it: exp(-6) < ALPHA_MIN, so nothing is drawn."""
_EXP = 0.9999999145565732, 0.9999917000566212, 0.49986904329342924, 0.165905882187667, 0.03964101756451029, 0.0057610589
"""exp(y) = sum_k _EXP[k] y^k for y in [_FAINT / 8, 0], to 1.7e-7 of the value: interpolation at Chebyshev points. The
compiler cannot compute several calls of math.exp at once."""

_U = np.uint64
"""Unsigned indices need no check for negative ones."""

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


@njit(cache=True, inline="always")
def _falloff(exponent):  # type: ignore[no-untyped-def]
    """exp of an exponent of at most 0."""
    y = max(exponent, np.float32(_FAINT)) * np.float32(0.125)
    p = np.float32(_EXP[5]) * y + np.float32(_EXP[4])
    p = ((p * y + np.float32(_EXP[3])) * y + np.float32(_EXP[2])) * y + np.float32(_EXP[1])
    p = p * y + np.float32(_EXP[0])
    p = p * p
    p = p * p
    return p * p


@njit(cache=True)
def _open_tile(tile: Array, planes: int, height: int, width: int) -> None:
    """Clears a tile of ``height`` rows and ``width`` columns; pixels beyond them count as done."""
    tile[: planes * _PIXELS] = 0
    for column in range(TILE):
        tile[planes * _PIXELS + column] = column
    for row in range(height):
        tile[row * TILE : row * TILE + width] = 1


@njit(cache=True)
def _first_open(tile: Array, pixel: int) -> int:
    """The first pixel, from the given one on, that is not done; _PIXELS if all are."""
    while pixel < _PIXELS and tile[pixel] == 0:
        pixel += 1
    return pixel


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
    for n in prange(len(start) - 1):
        top, left = n // across * TILE, n % across * TILE
        rows, columns = min(TILE, height - top), min(TILE, width - left)
        tile = np.empty(_FORWARD * _PIXELS + TILE, np.float32)
        _open_tile(tile, _FORWARD, rows, columns)
        first_open = 0
        for entry in range(start[n], start[n + 1]):
            s = listed[entry]
            _add_splat(splats[s], max(box[s, 2] - top, 0), min(box[s, 3] - top, rows - 1), top, left, tile)
            first_open = _first_open(tile, first_open)
            if first_open == _PIXELS:
                break
        for row in range(rows):
            for column in range(columns):
                for i in range(_VALUES):
                    out[top + row, left + column, i] = tile[(_SUMS + i) * _PIXELS + row * TILE + column]
    return out


@njit(cache=True, error_model="numpy")
def _add_splat(splat: Array, first: int, last: int, top: int, left: int, tile: Array) -> None:
    """Composites a splat to the rows ``first`` … ``last`` of a tile."""
    a, b, c, o = splat[CONIC_A], splat[CONIC_B], splat[CONIC_C], splat[OPACITY]
    red, green, blue, z = splat[RED], splat[RED + 1], splat[RED + 2], splat[Z]
    e2, du_0 = np.float32(-0.5) * a, np.float32(left) - splat[PIXEL_U]
    for row in range(first, last + 1):
        dv = np.float32(top + row) - splat[PIXEL_V]
        e1, e0 = -b * dv, np.float32(-0.5) * c * dv * dv
        for column in range(TILE):
            p = _U(row * TILE) + _U(column)
            T = tile[p]
            du = tile[_U(_FORWARD * _PIXELS) + _U(column)] + du_0
            alpha = min(np.float32(ALPHA_MAX), o * _falloff((e2 * du + e1) * du + e0))
            alpha = alpha if alpha >= np.float32(ALPHA_MIN) else np.float32(0)
            after = T - alpha * T
            after = after if after > np.float32(TRANSMITTANCE_MIN) else np.float32(0)
            w = alpha * T if after > np.float32(0) else np.float32(0)
            tile[p] = after
            tile[p + _U(_SUMS * _PIXELS)] += w * red
            tile[p + _U((_SUMS + 1) * _PIXELS)] += w * green
            tile[p + _U((_SUMS + 2) * _PIXELS)] += w * blue
            tile[p + _U((_SUMS + 3) * _PIXELS)] += w * z
            tile[p + _U((_SUMS + 4) * _PIXELS)] += w


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
    found = np.zeros((len(listed), COLUMNS), np.float32)
    for share in prange(DEALT):
        tile, sums = np.empty(_BACKWARD * _PIXELS + TILE, np.float32), np.empty(_SPLAT_SUMS * TILE, np.float32)
        for n in range(share, len(start) - 1, DEALT):
            top, left = n // across * TILE, n % across * TILE
            rows, columns = min(TILE, height - top), min(TILE, width - left)
            _open_tile(tile, _BACKWARD, rows, columns)
            for row in range(rows):
                for column in range(columns):
                    p = row * TILE + column
                    for i in range(_VALUES):
                        by_value = gradient[top + row, left + column, i]
                        tile[(_GRADIENT + i) * _PIXELS + p] = by_value
                        tile[_REST * _PIXELS + p] += out[top + row, left + column, i] * by_value
            first_open = 0
            for entry in range(start[n], start[n + 1]):
                s = listed[entry]
                first, last = max(box[s, 2] - top, 0), min(box[s, 3] - top, rows - 1)
                _take_splat(splats[s], first, last, top, left, tile, sums)
                _sum_columns(splats[s], left, sums, found[entry])
                first_open = _first_open(tile, first_open)
                if first_open == _PIXELS:
                    break
    return found


@njit(cache=True, error_model="numpy")
def _take_splat(splat: Array, first: int, last: int, top: int, left: int, tile: Array, sums: Array) -> None:
    """Derivatives of the loss by a splat, from the rows ``first`` … ``last`` of a tile: (8 x TILE) sums by column.
    Each of the three loops is small enough for the compiler to compute several columns at once."""
    a, b, c, o = splat[CONIC_A], splat[CONIC_B], splat[CONIC_C], splat[OPACITY]
    red, green, blue, z = splat[RED], splat[RED + 1], splat[RED + 2], splat[Z]
    e2, du_0 = np.float32(-0.5) * a, np.float32(left) - splat[PIXEL_U]
    for place in range(_SPLAT_SUMS * TILE):
        sums[_U(place)] = 0
    for row in range(first, last + 1):
        dv = np.float32(top + row) - splat[PIXEL_V]
        e1, e0 = -b * dv, np.float32(-0.5) * c * dv * dv
        for column in range(TILE):
            p = _U(row * TILE) + _U(column)
            T = tile[p]
            du = tile[_U(_BACKWARD * _PIXELS) + _U(column)] + du_0
            falloff = _falloff((e2 * du + e1) * du + e0)
            alpha = min(np.float32(ALPHA_MAX), o * falloff)
            alpha = alpha if alpha >= np.float32(ALPHA_MIN) else np.float32(0)
            after = T - alpha * T
            after = after if after > np.float32(TRANSMITTANCE_MIN) else np.float32(0)
            w = alpha * T if after > np.float32(0) else np.float32(0)
            tile[p] = after
            value = red * tile[p + _U(_GRADIENT * _PIXELS)] + green * tile[p + _U((_GRADIENT + 1) * _PIXELS)]
            value += blue * tile[p + _U((_GRADIENT + 2) * _PIXELS)] + z * tile[p + _U((_GRADIENT + 3) * _PIXELS)]
            value += tile[p + _U((_GRADIENT + 4) * _PIXELS)]
            rest = tile[p + _U(_REST * _PIXELS)] - w * value
            tile[p + _U(_REST * _PIXELS)] = rest
            by_alpha = T * value - rest / (np.float32(1) - alpha)
            by_alpha = by_alpha if w > np.float32(0) else np.float32(0)
            by_alpha = by_alpha if o * falloff <= np.float32(ALPHA_MAX) else np.float32(0)
            tile[p + _U(_BY_EXPONENT * _PIXELS)] = alpha * by_alpha
            tile[p + _U(_BY_OPACITY * _PIXELS)] = falloff * by_alpha
            tile[p + _U(_WEIGHT * _PIXELS)] = w
        for column in range(TILE):
            p, k = _U(row * TILE) + _U(column), _U(column)
            by_exponent = tile[p + _U(_BY_EXPONENT * _PIXELS)]
            sums[k] += by_exponent
            sums[k + _U(TILE)] += by_exponent * dv
            sums[k + _U(2 * TILE)] += by_exponent * dv * dv
            sums[k + _U(3 * TILE)] += tile[p + _U(_BY_OPACITY * _PIXELS)]
        for column in range(TILE):
            p, k = _U(row * TILE) + _U(column), _U(column)
            w = tile[p + _U(_WEIGHT * _PIXELS)]
            sums[k + _U(4 * TILE)] += w * tile[p + _U(_GRADIENT * _PIXELS)]
            sums[k + _U(5 * TILE)] += w * tile[p + _U((_GRADIENT + 1) * _PIXELS)]
            sums[k + _U(6 * TILE)] += w * tile[p + _U((_GRADIENT + 2) * _PIXELS)]
            sums[k + _U(7 * TILE)] += w * tile[p + _U((_GRADIENT + 3) * _PIXELS)]


@njit(cache=True, error_model="numpy")
def _sum_columns(splat: Array, left: int, sums: Array, found: Array) -> None:
    """The (10,) gradient of a splat from its sums by column."""
    a, b, c = splat[CONIC_A], splat[CONIC_B], splat[CONIC_C]
    sum_u = sum_v = sum_uu = sum_uv = sum_vv = np.float32(0)
    du = np.float32(left) - splat[PIXEL_U]
    for column in range(TILE):
        k = _U(column)
        along, across = sums[k] * du, sums[k + _U(TILE)]
        sum_u += along
        sum_uu += along * du
        sum_v += across
        sum_uv += across * du
        sum_vv += sums[k + _U(2 * TILE)]
        du += np.float32(1)
    found[PIXEL_U], found[PIXEL_V] = a * sum_u + b * sum_v, b * sum_u + c * sum_v
    found[CONIC_A], found[CONIC_B], found[CONIC_C] = np.float32(-0.5) * sum_uu, -sum_uv, np.float32(-0.5) * sum_vv
    for i in range(OPACITY, COLUMNS):
        total = np.float32(0)
        for column in range(TILE):
            total += sums[_U((i - 2) * TILE) + _U(column)]
        found[i] = total
