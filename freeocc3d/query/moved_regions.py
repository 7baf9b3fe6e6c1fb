"""Regions in another frame than the map's, for what prints their places."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..core.transforms import transform
from ..core.types import Occupancy
from .regions import Region

_CORNERS = np.stack(np.unravel_index(np.arange(8), (2, 2, 2)), axis=1) - 0.5


def region_mover(occupancy: Occupancy, T_frame_map: NDArray[np.float64]) -> Callable[[Region], Region]:
    """Returns a function that gives a region with its centroid, and the box around its voxels, in a frame.
    T_frame_map: (4, 4), rigid."""
    if np.array_equal(T_frame_map, np.eye(4)):
        return lambda region: region
    edges = occupancy.occupied_edges()
    centers = occupancy.centers(occupancy.occupied_voxels(), edges)

    def moved(region: Region) -> Region:
        own = edges[region.rows, None, None] * occupancy.finest
        corners = transform(T_frame_map, (centers[region.rows, None] + own * _CORNERS).reshape(-1, 3))
        return replace(
            region,
            centroid=np.asarray(transform(T_frame_map, region.centroid)),
            box_min=corners.min(axis=0),
            box_max=corners.max(axis=0),
        )

    return moved
