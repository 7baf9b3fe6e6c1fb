"""Depth of a view from the surface of the whole scan."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ...types import Intrinsics
from .consistency import DepthImage
from .photo_consistency import rays
from .watertight import Surface

_MEASURED = 6.0  # cells: triangles with longer edges span what nothing was measured of
_SUREST, _LAYOUT_SIGMA = 1.0 / 300.0, 0.01  # standard deviations over depth
_AROUND = 0.97, 1.1  # times the surface's depth between which the plane of a wall may take its place


class Layout(Protocol):
    """The planes of a building: its walls, floors and ceilings."""

    def nearest(
        self, origin: NDArray[np.float64], directions: NDArray[np.float64], least_times: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """How many times each of (H, W, 3) directions reaches the first plane that is ``least_times`` away or more; 0 =
        there is none."""
        ...


def surface_depth(
    surface: Surface, layout: Layout | None, camera: Intrinsics, T_world_cam: NDArray[np.float64]
) -> DepthImage:
    """The surface as a camera sees it, where it was measured; where it only spans a gap, the layout's plane near it."""
    origin = T_world_cam[:3, 3]
    directions = np.moveaxis(rays(camera).numpy().astype(np.float64), 0, -1) @ T_world_cam[:3, :3].T
    met = surface.met(origin, directions)
    times = met.times.astype(np.float64)
    measured = (times > 0) & (met.edge_m < _MEASURED * surface.cell_m)
    depth = np.where(measured, times, 0.0)
    if layout is not None:
        plane = layout.nearest(origin, directions, _AROUND[0] * times)
        depth = np.where(~measured & (plane < _AROUND[1] * times), plane, depth)
    inverse = np.divide(1.0, depth, out=np.zeros_like(depth), where=depth > 0)
    sigma = np.where(measured, np.maximum(met.sigma_m * inverse, _SUREST), _LAYOUT_SIGMA) * inverse
    return DepthImage(inverse.astype(np.float32), sigma.astype(np.float32), camera, T_world_cam)
