"""Plans of a map: its voxels from above, fitted into a part of a picture."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ..query.scan_map import Map
from .scene_rendering import choose_cut_height, turn_lengthwise


class FloorPlan:
    """Where places of a map lie in a plan; the longer extent of the map runs from left to right.

    drawn: rows of the occupied voxels below the cut near the ceiling, lowest first.  heights: (V,) of all occupied
    voxels' centers, meters.  scale: pixels per meter.
    """

    def __init__(self, scan_map: Map, window: tuple[int, int, int, int], margin: int):
        """window: x0, y0, x1, y1 pixels of the picture; the plan fills it but for a margin."""
        occupancy = scan_map.occupancy
        self._window = window
        edges = occupancy.occupied_edges()
        self._centers, self._edges_m = occupancy.centers(occupancy.occupied_voxels(), edges), edges * occupancy.finest
        self._R = turn_lengthwise(scan_map.T_gravity_map[:3, :3], self._centers)
        turned = self._centers @ self._R.T
        low, high = turned[:, :2].min(axis=0), turned[:, :2].max(axis=0)
        x0, y0, x1, y1 = window
        room = np.array((x1 - x0 - 2 * margin, y1 - y0 - 2 * margin))
        self.scale = float((room / np.maximum(high - low + 2 * occupancy.voxel_size, 1e-9)).min())
        self._middle, self._center = 0.5 * (low + high), 0.5 * np.array((x0 + x1, y0 + y1))
        self.heights = turned[:, 2]
        below = np.flatnonzero(self.heights <= choose_cut_height(self.heights, occupancy.voxel_size))
        self.drawn = below[np.argsort(self.heights[below], kind="stable")]

    def pixel(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Returns the (N, 2) pixels of (N, 3) places, map frame."""
        flat = (points @ self._R.T)[:, :2]
        return np.asarray(self._center + (flat - self._middle) * (self.scale, -self.scale))

    def draw_voxels(self, picture: NDArray[np.uint8], rows: NDArray[np.int64], colors: NDArray[np.uint8]) -> None:
        """Draws occupied voxels, the last one of a size on top, small ones above large ones. rows: (n,).  colors:
        (n, 3)."""
        x0, y0, x1, y1 = self._window
        for edge in np.unique(self._edges_m[rows])[::-1]:
            own = self._edges_m[rows] == edge
            size = max(1, math.ceil(self.scale * edge))
            u, v = np.rint(self.pixel(self._centers[rows[own]]) - 0.5 * size).astype(np.int64).T
            inside = (u >= x0) & (v >= y0) & (u <= x1 - size) & (v <= y1 - size)
            for dv in range(size):
                for du in range(size):
                    picture[v[inside] + dv, u[inside] + du] = colors[own][inside]
