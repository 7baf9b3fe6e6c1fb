"""Oriented bounding boxes of regions. The module imports little, to start fast."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..core.transforms import invert, transform
from ..core.types import Occupancy
from .regions import Region

_CORNERS = np.stack(np.unravel_index(np.arange(8), (2, 2, 2)), axis=1)
_SAME_AREA, _SAME_EDGE = (
    1.0 + 1e-6,
    1.0 + 1e-3,
)  # rounding in a slightly tilted lattice must not make a square longer one way


@dataclass(frozen=True)
class OrientedBox:
    """An upright oriented bounding box: its z points up, its x along its longer level edge.

    extent: (3,) meters along its own x, y, z.  yaw: radians in (-pi/2, pi/2], from the gravity frame's x to the box's.
    T_map_box: (4, 4) rigid, from the box's frame to the map's; the box's center is its origin.
    """

    extent: NDArray[np.float64]
    yaw: float
    T_map_box: NDArray[np.float64]


def oriented_boxes(
    occupancy: Occupancy, regions: Sequence[Region], T_gravity_map: NDArray[np.float64]
) -> list[OrientedBox]:
    """Returns the upright box with the least level area around each region's voxels, faces included.

    T_gravity_map: (4, 4) rigid, to a frame with z up.
    """
    voxels, edges = occupancy.occupied_voxels(), occupancy.occupied_edges()
    boxes = []
    for region in regions:
        lattice = voxels[region.rows, None] + _CORNERS * edges[region.rows, None, None]
        corners = occupancy.origin + lattice.reshape(-1, 3) * occupancy.finest
        boxes.append(_box_around(transform(T_gravity_map, corners), T_gravity_map))
    return boxes


def _box_around(corners: NDArray[np.float64], T_gravity_map: NDArray[np.float64]) -> OrientedBox:
    """Returns the box around (N, 3) points in the gravity frame.

    The least rectangle around a convex outline has a side along a side of the outline. Source: H. Freeman, R. Shapira,
    Determining the Minimum-Area Encasing Rectangle for an Arbitrary Closed Curve, CACM 1975.
    """
    from scipy.spatial import ConvexHull

    low, high = float(corners[:, 2].min()), float(corners[:, 2].max())
    outline = corners[ConvexHull(corners[:, :2]).vertices, :2]
    sides = np.roll(outline, -1, axis=0) - outline
    quarter = np.pi / 2
    turns = (np.arctan2(sides[:, 1], sides[:, 0]) + quarter / 2) % quarter - quarter / 2
    along = np.stack((np.cos(turns), np.sin(turns)), axis=1) @ outline.T  # (sides, points)
    across = np.stack((-np.sin(turns), np.cos(turns)), axis=1) @ outline.T
    area = np.ptp(along, axis=1) * np.ptp(across, axis=1)
    least = np.flatnonzero(area <= area.min() * _SAME_AREA)
    best = least[np.argmin(np.abs(turns[least]))]  # of equal boxes, the one turned least
    spans = np.array([(line.min(), line.max()) for line in (along[best], across[best])])
    yaw, extent, middle = float(turns[best]), np.ptp(spans, axis=1), spans.mean(axis=1)
    center = middle @ np.array(((np.cos(yaw), np.sin(yaw)), (-np.sin(yaw), np.cos(yaw))))
    if extent[1] > extent[0] * _SAME_EDGE:
        extent = extent[::-1]
        yaw = yaw + quarter if yaw <= 0 else yaw - quarter
    T_gravity_box = np.eye(4)
    T_gravity_box[:2, :2] = ((np.cos(yaw), -np.sin(yaw)), (np.sin(yaw), np.cos(yaw)))
    T_gravity_box[:3, 3] = (*center, (low + high) / 2)
    return OrientedBox(np.array((*extent, high - low)), yaw, np.asarray(invert(T_gravity_map) @ T_gravity_box))
