"""Colors that differ from each other, and from a pale map, also for color-blind people."""

from __future__ import annotations

import functools

import numpy as np
from numpy.typing import NDArray

GENERATED = 256
"""So many colors are chosen for their distance; later ones only differ."""

_VISIONS = np.array((
    ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    ((0.152286, 1.052583, -0.204868), (0.114503, 0.786281, 0.099216), (-0.003882, -0.048116, 1.051998)),
    ((0.367322, 0.860646, -0.227968), (0.280085, 0.672501, 0.047413), (-0.011820, 0.042940, 0.968881)),
))  # fmt: skip
"""Linear RGB as seen with normal vision, protanopia and deuteranopia. Source: G. Machado et al., A
Physiologically-based Model for Simulation of Color Vision Deficiency, TVCG 2009, severity 1."""
_LMS = np.array((
    (0.4122214708, 0.5363325363, 0.0514459929),
    (0.2119034982, 0.6806995451, 0.1073969566),
    (0.0883024619, 0.2817188376, 0.6299787005),
))  # fmt: skip
_LAB = np.array((
    (0.2104542553, 0.7936177850, -0.0040720468),
    (1.9779984951, -2.4285922050, 0.4505937099),
    (0.0259040371, 0.7827717662, -0.8086757660),
))  # fmt: skip
"""Of OKLab. Source: B. Ottosson, A perceptual color space for image processing, 2020."""
_LIGHTNESS = 0.7  # its share in a distance: the faces of a cube differ in it, too
_FIRST = np.array(((213, 94, 0), (0, 114, 178), (240, 228, 66)), np.uint8)
"""Those of M. Okabe and K. Ito, Color Universal Design, 2008, that stand out from a pale map for everyone."""
_DARKEST, _DULLEST, _FROM_PALE = 0.35, 0.1, 0.085  # OKLab lightness, chroma, and distance from every pale color
_STEPS = 16
_SCATTER = 0x9E3779B1  # odd, so that its multiples reach every 24-bit number once


def pale_colors(colors: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Returns the (N, 3) pale and almost gray variants of (N, 3) colors, which strong colors stand out from."""
    gray = colors.astype(np.float32).mean(axis=1, keepdims=True)
    return np.asarray(0.12 * colors + 0.36 * gray + 0.52 * 232.0).astype(np.uint8)


def distinct_colors(count: int) -> NDArray[np.uint8]:
    """Returns (count, 3) RGB. No two are the same; the first are the most different, and the first n are the same for
    every count.

    Each color is the farthest from those before it, by the least of its distances with normal vision, protanopia and
    deuteranopia. Of the first 8, two are at least 0.10 apart in OKLab (lightness counts 0.7); of 30, 0.04; a difference
    that one can just see is 0.02. Each is at least 0.08 from every color of ``pale_colors``.
    """
    chosen = _farthest(min(count, GENERATED))
    if count <= len(chosen):
        return chosen[:count].copy()
    number = (np.arange(count, dtype=np.uint64) * _SCATTER) % 2**24
    others = np.stack((number >> 16, number >> 8 & 255, number & 255), axis=1).astype(np.uint8)
    used = (others[:, None] == chosen).all(axis=2).any(axis=1)
    return np.concatenate((chosen, others[~used]))[:count]


def measure_distances(colors: NDArray[np.uint8], others: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Returns (N, M) distances of (N, 3) from (M, 3) RGB: for each pair the least that people with one of the three
    visions see."""
    apart = _seen(colors)[:, :, None] - _seen(others)[:, None]
    return np.asarray(np.linalg.norm(apart, axis=-1).min(axis=0))


def every_color(steps: int = _STEPS) -> NDArray[np.uint8]:
    """Returns (steps^3, 3) RGB, evenly spread."""
    return np.rint(np.indices((steps,) * 3).reshape(3, -1).T * (255 / (steps - 1))).astype(np.uint8)


def _seen(colors: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Returns (3, N, 3) OKLab with the lightness reduced, of (N, 3) RGB in each vision."""
    part = colors / 255.0
    linear = np.where(part <= 0.04045, part / 12.92, ((part + 0.055) / 1.055) ** 2.4)
    lms = np.clip(linear @ _VISIONS.transpose(0, 2, 1), 0, 1) @ _LMS.T
    return np.asarray(np.cbrt(lms) @ _LAB.T * (_LIGHTNESS, 1, 1))


@functools.cache
def _farthest(count: int) -> NDArray[np.uint8]:
    """Returns (count, 3) colors, each the farthest from those before it."""
    candidates = every_color()
    lightness, *chroma = _seen(candidates)[0].T
    strong = (lightness >= _LIGHTNESS * _DARKEST) & (np.hypot(*chroma) >= _DULLEST)
    candidates = candidates[strong]
    pale = measure_distances(candidates, pale_colors(every_color(5))).min(axis=1)
    candidates = candidates[pale >= _FROM_PALE]
    seen = _seen(candidates)
    nearest = np.full(len(candidates), np.inf)
    chosen: list[NDArray[np.uint8]] = []
    for number in range(count):
        chosen.append(_FIRST[number] if number < len(_FIRST) else candidates[np.argmax(nearest)])
        distance = np.linalg.norm(seen - _seen(chosen[-1][None]), axis=-1).min(axis=0)
        nearest = np.minimum(nearest, distance)
    return np.array(chosen, np.uint8).reshape(-1, 3)
