"""Depth of a view from the surface of the whole scan."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...types import Intrinsics
from .consistency import DepthImage
from .layout import Layout
from .photo_consistency import rays
from .watertight import Surface

_MEASURED = 6.0  # cells: triangles with longer edges span what nothing was measured of
_SUREST, _LAYOUT_SIGMA = 1.0 / 300.0, 0.01  # standard deviations over depth


def surface_depth(surface: Surface, layout: Layout, camera: Intrinsics, T_world_cam: NDArray[np.float64]) -> DepthImage:
    """The surface as a camera sees it, where it was measured; where it only spans a gap, the layout's plane near it."""
    origin = T_world_cam[:3, 3]
    directions = np.moveaxis(rays(camera).numpy().astype(np.float64), 0, -1) @ T_world_cam[:3, :3].T
    met = surface.met(origin, directions)
    times = met.times.astype(np.float64)
    times[times < surface.cell_m] = 0.0  # a surface through the camera itself
    measured = (times > 0) & (met.edge_m < _MEASURED * surface.cell_m)
    depth = np.where(measured, times, 0.0)
    depth[~measured] = layout.near(origin, directions[~measured], times[~measured])
    inverse = np.divide(1.0, depth, out=np.zeros_like(depth), where=depth > 0)
    sigma = np.where(measured, np.maximum(met.sigma_m * inverse, _SUREST), _LAYOUT_SIGMA) * inverse
    return DepthImage(inverse.astype(np.float32), sigma.astype(np.float32), camera, T_world_cam)
