"""How a point of the built-in room's surface looks: procedural textures, grain and a fixed light.

Everything here is made up, so that images have what features and stereo need: contrast at all scales, and no two places
that look the same.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ...core.compiling import njit
from .builtin_room import BOOKS, CHECKER, PAINTING, PATCHES, PLAIN, PLASTER, SIZE, STRIPES, WOOD

_LIGHT = (0.34, -0.24, 0.91)  # unit vector toward the light, the same for all points, as for a distant lamp
_AMBIENT, _LAMBERT = 0.87, 0.13
"""Shares of the light that falls on all surfaces alike, and that falls on those that face the lamp."""

_CORNER_SHADE, _CORNER_M = 0.22, 0.15
"""Share of the light that is missing right at a wall, and the distance over which it comes back by a factor of e."""

_ALONG_WALL = 0.9  # cosine of a normal to the wall's: a wall does not darken itself or what lies on it

_COARSE_SIZE, _COARSE_GRAIN = 0.35, 0.14
"""Size of coarse grain over that of the texture, and how much it changes brightness."""

_FINE_M, _FINE_GRAIN = 0.013, 0.10
"""Size of fine grain, meters, the same on all materials, and how much it changes brightness."""

_GRAIN_LEVELS = 24.0  # gray levels that grain adds as well, so that black things have texture
_FADED_PX = 3.0  # pixels that a texture's features must be wide to be seen in full
_TINY_M = 1e-6  # keeps a pixel of no extent from dividing

_WOOD_LONG, _WOOD_WIDE, _WOOD_BENT = 6, 2, 1.5
"""Features that wood's grain is wavy over, along and across it, and by how many of its rings."""

_WOOD_BASE, _WOOD_RINGS, _WOOD_SPOTS, _WOOD_BOARDS = 0.1, 0.15, 0.4, 0.5
"""Place between wood's colors: its least, and what rings, spots and boards add to it."""

_BOARD = 3  # features that a board of wood is wide
_SHELF_M = 0.4  # height between bookshelf's boards: rows of books have their own colors
_BOOK_RANGE, _BOOK_LEAST = 1.6, -0.3  # of books' places between two colors, so that some lie beyond them
_PATCH_RANGE, _PATCH_LEAST = 1.5, -0.25
_TONES, _TONE, _TONE_LEAST = 5.0, 0.35, -0.2  # of a painting: how many, the step between them, the first

_COARSE_SEED, _FINE_SEED, _WOOD_SEED, _PATCHES_SEED, _PLASTER_SEED, _PAINTING_SEED, _BANDS_SEED = (
    23,
    29,
    3,
    11,
    17,
    31,
    5,
)
_BANDS_LAYER = 7
"""Which noise is which: any numbers, as long as they differ."""

_MIX_I, _MIX_J, _MIX_K, _MIX_SEED, _MIX_LAST = 374761393, 668265263, 2147483647, 1274126177, 2246822519
"""Large odd numbers that spread the bits of lattice coordinates; three are the primes of xxHash
(https://github.com/Cyan4973/xxHash/blob/dev/doc/xxhash_spec.md)."""

_BITS_32, _BITS_16 = 0xFFFFFFFF, 0xFFFF


@njit(nogil=True, cache=True)  # on one core: the tracker uses the others while frames are read ahead
def shade(
    points: NDArray[np.float32],
    triangle: NDArray[np.int32],
    footprint: NDArray[np.float32],
    textures: NDArray[np.int32],
    colors: NDArray[np.float32],
    scales: NDArray[np.float32],
    normals: NDArray[np.float32],
) -> NDArray[np.uint8]:
    """(P, 3) RGB of P surface points: a mix of the material's two colors, times a fixed light. A point looks the same
    from every direction. Detail finer than a pixel fades out.

    points: (P, 3) world, meters.  triangle: (P,) row in the arrays of ``Room``; -1 = nothing, which is black.
    footprint: (P,) size of a pixel on the surface, meters.
    """
    image = np.zeros((len(points), 3), np.uint8)
    for p in range(len(points)):
        t = triangle[p]
        if t < 0:
            continue
        x, y, z = float(points[p, 0]), float(points[p, 1]), float(points[p, 2])
        scale, pixel = float(scales[t]), float(footprint[p])
        fade = min(1.0, scale / (_FADED_PX * pixel + _TINY_M))
        mix = _texture(textures[t], x, y, z, normals[t], scale, pixel)
        mix = 0.5 + (mix - 0.5) * fade if textures[t] != PLAIN else 0.0
        size = _COARSE_SIZE * scale
        coarse = _noise(x / size, y / size, z / size, _COARSE_SEED) - 0.5
        fine = _noise(x / _FINE_M, y / _FINE_M, z / _FINE_M, _FINE_SEED) - 0.5
        grain = _COARSE_GRAIN * coarse * min(1.0, size / (2.0 * pixel)) + _FINE_GRAIN * fine * min(
            1.0, _FINE_M / (2.0 * pixel)
        )
        light = _lighting(x, y, z, normals[t])
        for channel in range(3):
            value = colors[t, 0, channel] + mix * (colors[t, 1, channel] - colors[t, 0, channel])
            value = (value * (1.0 + grain) + _GRAIN_LEVELS * grain) * light
            image[p, channel] = np.uint8(min(max(value, 0.0), 255.0))
    return image


@njit(cache=True)
def _texture(kind: int, x: float, y: float, z: float, normal: NDArray[np.float32], scale: float, pixel: float) -> float:
    """Mixing weight of a material's two colors, mostly in 0…1."""
    # Surface coordinates: the two axes that are not along the normal.
    nx, ny, nz = abs(normal[0]), abs(normal[1]), abs(normal[2])
    if nz >= nx and nz >= ny:
        a, b = x, y
    elif nx >= ny:
        a, b = y, z
    else:
        a, b = x, z
    if kind == WOOD:
        wobble = _noise(a / (_WOOD_LONG * scale), b / (_WOOD_WIDE * scale), 0.5, _WOOD_SEED)
        grain = math.sin(2 * math.pi * (b / scale + _WOOD_BENT * wobble))
        boards = _bands(b, _BOARD * scale, 0, pixel)
        return _WOOD_BASE + _WOOD_RINGS * grain + _WOOD_SPOTS * wobble + _WOOD_BOARDS * boards
    if kind == CHECKER:
        wave = math.sin(math.pi * a / scale) * math.sin(math.pi * b / scale)
        return min(max(0.5 + wave * scale / (math.pi * pixel + _TINY_M), 0.0), 1.0)  # edges one pixel soft
    if kind == BOOKS:  # each book has its own color, between the two and beyond
        return _BOOK_RANGE * _bands(a, scale, math.floor(z / _SHELF_M), pixel) + _BOOK_LEAST
    if kind == PATCHES:
        return _PATCH_RANGE * _noise(a / scale, b / scale, 0.5, _PATCHES_SEED) + _PATCH_LEAST
    if kind == PLASTER:
        return _noise(x / scale, y / scale, z / scale, _PLASTER_SEED)
    if kind == STRIPES:
        return _bands(a, scale, 1, pixel)
    if kind == PAINTING:  # flat areas of five tones
        return _TONE * math.floor(_TONES * _noise(a / scale, b / scale, 0.5, _PAINTING_SEED)) + _TONE_LEAST
    return 0.0


@njit(cache=True)
def _bands(a: float, width: float, row: int, pixel: float) -> float:
    """Bands across ``a``, each with its own tone in 0…1, so that features do not match another band. Soft edges."""
    edge = math.floor(a / width + 0.5)
    before, after = _hash(edge - 1, row, _BANDS_LAYER, _BANDS_SEED), _hash(edge, row, _BANDS_LAYER, _BANDS_SEED)
    return before + (after - before) * min(max((a - edge * width) / (pixel + _TINY_M) + 0.5, 0.0), 1.0)


@njit(cache=True)
def _lighting(x: float, y: float, z: float, normal: NDArray[np.float32]) -> float:
    """Ambient and Lambertian light in 0…1, darker near the room's edges, where surfaces block more of the light."""
    lambert = normal[0] * _LIGHT[0] + normal[1] * _LIGHT[1] + normal[2] * _LIGHT[2]
    light = _AMBIENT + _LAMBERT * lambert
    to_walls = (SIZE[0] / 2 - abs(x), SIZE[1] / 2 - abs(y), min(z, SIZE[2] - z))
    for axis in range(3):
        if abs(normal[axis]) < _ALONG_WALL:
            light *= 1.0 - _CORNER_SHADE * math.exp(-max(to_walls[axis], 0.0) / _CORNER_M)
    return light


@njit(cache=True)
def _hash(i: int, j: int, k: int, seed: int) -> float:
    """A pseudorandom number in 0…1 for each lattice point."""
    h = (i * _MIX_I + j * _MIX_J + k * _MIX_K + seed * _MIX_SEED) & _BITS_32
    h = ((h ^ (h >> 13)) * _MIX_SEED) & _BITS_32
    h = ((h ^ (h >> 16)) * _MIX_LAST) & _BITS_32
    return float((h ^ (h >> 15)) & _BITS_16) / _BITS_16


@njit(cache=True)
def _noise(x: float, y: float, z: float, seed: int) -> float:
    """Value noise in 0…1: smoothly interpolated lattice numbers."""
    i, j, k = math.floor(x), math.floor(y), math.floor(z)
    u, v, w = x - i, y - j, z - k
    u, v, w = u * u * (3 - 2 * u), v * v * (3 - 2 * v), w * w * (3 - 2 * w)
    total = 0.0
    for a in range(2):
        for b in range(2):
            for c in range(2):
                weight = (u if a else 1 - u) * (v if b else 1 - v) * (w if c else 1 - w)
                total += weight * _hash(i + a, j + b, k + c, seed)
    return total
