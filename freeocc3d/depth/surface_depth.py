"""Renders the depth map of a view from the surface of the whole scan."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..core.types import Intrinsics
from .building_planes import Layout
from .cross_view_check import DepthImage
from .photo_consistency import compute_rays
from .watertight_surface import SIDE_BY_SIDE, WatertightSurface

_SPANNED, _FACING = 40.0, 0.4  # longest edge, in cells, and smallest cosine of a triangle that may fill a gap
_ALIKE = 0.2  # relative
_LEAST_COVERED = 0.5  # of the pixels that a view measured itself
_SUREST, _LAYOUT_SIGMA, _SPANNED_SIGMA = 0.005, 0.01, 0.04  # standard deviations over depth


def render_surface_depth(
    surface: WatertightSurface, layout: Layout, camera: Intrinsics, T_world_cam: NDArray[np.float64]
) -> DepthImage:
    """Render the surface as a camera sees it. Measured parts keep their depth. Where the surface only spans a gap, a
    plane of the layout near it is used or, without one, the surface if the gap is small."""
    origin = T_world_cam[:3, 3]
    directions = np.moveaxis(compute_rays(camera).numpy().astype(np.float64), 0, -1) @ T_world_cam[:3, :3].T
    met = surface.met(origin, directions)
    times = met.times.astype(np.float64)
    times[times < surface.cell_m] = 0.0  # the surface passes through the camera
    measured = (times > 0) & (met.edge_m < SIDE_BY_SIDE * surface.cell_m)
    spanned = (times > 0) & (met.edge_m < _SPANNED * surface.cell_m) & (met.cosine > _FACING)
    depth = np.where(measured | spanned, times, 0.0)
    plane = np.zeros_like(depth)
    plane[~measured] = layout.near(origin, directions[~measured], times[~measured])
    depth = np.where(plane > 0, plane, depth)
    inverse = np.divide(1.0, depth, out=np.zeros_like(depth), where=depth > 0)
    sigma = np.where(plane > 0, _LAYOUT_SIGMA, np.maximum(met.sigma_m * inverse, _SUREST))
    sigma = np.where(measured | (plane > 0), sigma, _SPANNED_SIGMA) * inverse
    return DepthImage(inverse.astype(np.float32), sigma.astype(np.float32), camera, T_world_cam)


def prefer_own_depth(own: DepthImage, surface: DepthImage) -> DepthImage:
    """Use a view's own depth where the ``surface`` does not contradict it, and the surface elsewhere. The surface
    merges details smaller than its cells, and averages the poses of all views instead of following this view's pose.

    A surface that lacks most of what the view measured is no surface of the scan: few views carve too little of the
    space before it. The view's own depth then stays where there is no surface."""
    measured, covered = own.inverse > 0, surface.inverse > 0
    use = measured & (np.abs(own.inverse - surface.inverse) < _ALIKE * surface.inverse)
    if np.count_nonzero(measured & covered) < _LEAST_COVERED * np.count_nonzero(measured):
        use |= measured & ~covered
    inverse = np.where(use, own.inverse, surface.inverse)
    sigma = np.where(use, np.maximum(own.sigma, surface.sigma), surface.sigma)
    return DepthImage(inverse, sigma, surface.camera, surface.T_world_cam)
