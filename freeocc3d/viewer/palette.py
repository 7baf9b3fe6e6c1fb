"""Colors for classes, heights and the regions of a query."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..core.types import Occupancy
from ..query.regions import Region
from .distinct_colors import distinct_colors, every_color, measure_distances, pale_colors

_KNOWN = {
    "wall": (200, 205, 210), "floor": (150, 125, 100), "ceiling": (225, 225, 215), "window": (150, 200, 235),
    "door": (165, 110, 65), "black": (25, 25, 25), "grey": (128, 128, 128), "white": (245, 245, 245),
    "red": (215, 35, 40), "orange": (245, 135, 30), "yellow": (245, 215, 45), "green": (45, 160, 70),
    "turquoise": (45, 185, 185), "blue": (40, 90, 215), "purple": (120, 50, 165), "pink": (245, 130, 180),
    "brown": (115, 70, 35), "beige": (220, 195, 155),
}  # fmt: skip


_UNKNOWN = (90, 90, 90)
_APART, _ROOM = 0.06, 3.0
"""Least distance of the colors of two classes, as ``distinct_colors.measure_distances`` has it; with more classes than
there is room for, ``_ROOM`` over their number."""


def assign_class_colors(names: list[str]) -> NDArray[np.uint8]:
    """Returns (C + 1, 3) RGB: row 0 for "nothing known", row k for names[k - 1]. A name always has the same color,
    unless an earlier one of the names has one that looks alike: then it has the nearest color that does not."""
    fixed = {name: _KNOWN[name] for name in names if name in _KNOWN}
    taken = np.array([_UNKNOWN, *fixed.values()], np.uint8)
    every = every_color()
    least = min(_APART, _ROOM / max(len(names), 1))
    room = measure_distances(every, taken).min(axis=1)
    for name in dict.fromkeys(names):
        if name in fixed:
            continue
        color = np.array([_hashed(name)], np.uint8)
        if measure_distances(color, taken).min() < least:
            apart = every[room >= least] if room.max() >= least else every[[np.argmax(room)]]
            color = apart[[np.argmin(measure_distances(color, apart))]]
        fixed[name] = tuple(color[0].tolist())
        taken = np.concatenate((taken, color))
        room = np.minimum(room, measure_distances(every, color)[:, 0])
    return np.array([_UNKNOWN, *(fixed[name] for name in names)], np.uint8)


def word_colors(words: Sequence[list[Region]]) -> NDArray[np.uint8]:
    """Returns (W, 3) RGB of ``distinct_colors`` for the words with these regions; words that found something have the
    most different ones."""
    colors = np.zeros((len(words), 3), np.uint8)
    colors[sorted(range(len(words)), key=lambda row: not words[row])] = distinct_colors(len(words))
    return colors


def highlight_regions(colors: NDArray[np.uint8], words: Sequence[list[Region]]) -> NDArray[np.uint8]:
    """Returns (V, 3) voxel colors: regions in their word's color, everything else pale. A voxel
    of several regions has the color of the smallest one, of equal ones that of the first word."""
    out = pale_colors(colors)
    chosen = word_colors(words)
    found = [(len(region.rows), -number, region.rows) for number, regions in enumerate(words) for region in regions]
    for _, number, rows in sorted(found, key=lambda one: (-one[0], one[1])):
        out[rows] = chosen[-number]
    return out


def color_by_height(occupancy: Occupancy, up: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Returns the (V, 3) color of each occupied voxel by its height along ``up``, from dark blue to yellow."""
    height = occupancy.centers(occupancy.occupied_voxels(), occupancy.occupied_edges()) @ up
    return color_by_value((height - height.min()) / max(float(np.ptp(height)), 1e-9))


def color_by_value(values: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Returns the (N, 3) viridis colors of (N,) values in 0…1."""
    import cv2  # not above: a query's PLY does not need it and starts faster without it

    level = np.rint(255 * np.clip(values, 0, 1)).astype(np.uint8)
    return np.asarray(cv2.applyColorMap(level[:, None], cv2.COLORMAP_VIRIDIS)[:, 0, ::-1], np.uint8)


def _hashed(name: str) -> tuple[int, int, int]:
    """Returns a saturated color. The name sets its hue, and a little of its lightness."""
    digest = hashlib.sha256(name.encode()).digest()
    hue = digest[0] / 256 * 6
    value = 170 + digest[1] % 70
    ramp = hue % 1
    low, rise, fall = 0.3, 0.3 + 0.7 * ramp, 1.0 - 0.7 * ramp
    rgb = [(1, rise, low), (fall, 1, low), (low, 1, rise), (low, fall, 1), (rise, low, 1), (1, low, fall)][int(hue)]
    return tuple(int(value * part) for part in rgb)  # type: ignore[return-value]
