"""Colors for classes, heights and the regions of a query."""

from __future__ import annotations

import hashlib

import numpy as np
from numpy.typing import NDArray

from ..core.types import Occupancy
from ..query.regions import Region

HIGHLIGHTS = np.array(
    [(255, 64, 32), (20, 120, 255), (30, 190, 70), (240, 60, 200), (255, 170, 0), (0, 190, 200)], np.uint8
)
"""Strong colors for the words of a query, in turn."""

_KNOWN = {
    "wall": (200, 205, 210), "floor": (150, 125, 100), "ceiling": (225, 225, 215), "window": (150, 200, 235),
    "door": (165, 110, 65), "black": (25, 25, 25), "grey": (128, 128, 128), "white": (245, 245, 245),
    "red": (215, 35, 40), "orange": (245, 135, 30), "yellow": (245, 215, 45), "green": (45, 160, 70),
    "turquoise": (45, 185, 185), "blue": (40, 90, 215), "purple": (120, 50, 165), "pink": (245, 130, 180),
    "brown": (115, 70, 35), "beige": (220, 195, 155),
}  # fmt: skip


def assign_class_colors(names: list[str]) -> NDArray[np.uint8]:
    """Returns (C + 1, 3) RGB: row 0 for "nothing known", row k for names[k - 1]. A name always has the same color."""
    rows = [(90, 90, 90), *(_KNOWN.get(name) or _hashed(name) for name in names)]
    return np.array(rows, np.uint8)


def highlight_regions(colors: NDArray[np.uint8], words: list[list[Region]]) -> NDArray[np.uint8]:
    """Returns (V, 3) voxel colors: regions in their word's strong color, everything else pale and gray."""
    gray = colors.astype(np.float32).mean(axis=1, keepdims=True)
    pale = 0.25 * colors + 0.35 * gray + 0.4 * 215.0
    out = np.clip(pale, 0, 255).astype(np.uint8)
    for number, regions in enumerate(words):
        for region in regions:
            out[region.rows] = HIGHLIGHTS[number % len(HIGHLIGHTS)]
    return out


def color_by_number(count: int) -> NDArray[np.uint8]:
    """Returns (count, 3) RGB: one color for each number from 0. Neighbors differ: hues turn by the golden ratio, which
    divides the circle most evenly, whatever the count, and every other color is darker."""
    number = np.arange(count)
    hue = 6 * (number * (5**0.5 - 1) / 2 % 1)
    ramp = np.clip(np.abs((hue[:, None] + (3.0, 5.0, 1.0)) % 6 - 3) - 1, 0, 1)  # of red, green and blue
    return np.asarray(np.where(number % 2, 175, 235)[:, None] * (0.25 + 0.75 * ramp), np.float64).astype(np.uint8)


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
