"""Draws voxel grids for comparison: from above and from a corner, all with the same view."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ..occupancy.surface_faces import build_faces
from .scene_rendering import DrawnScene, choose_cut_height, render_scene, shade_faces, turn_upright
from .view_cameras import VIEWS, aim

SIZE = 880, 600
"""Width and height of one view, pixels; a picture has two views, one above the other."""


@dataclass(frozen=True)
class LabelGrid:
    """A voxel grid to draw.

    labels: (X, Y, Z) uint8, 0 is not drawn.  colors: (K, 3) uint8 RGB of label 0, 1, …  path: (P, 3) camera path,
    meters, in the grid's frame.
    """

    labels: NDArray[np.uint8]
    colors: NDArray[np.uint8]
    path: NDArray[np.float64]


def draw_grids(
    grids: Mapping[str, LabelGrid], origin: NDArray[np.float64], voxel_size: float, up: NDArray[np.float64]
) -> dict[str, bytes]:
    """Returns a PNG of each grid. All grids lie on one lattice, are cut below the ceiling at the same height, and are
    seen from the corner of the first grid's camera. Returns none if all are empty.

    origin: (3,) lower corner of voxel (0, 0, 0), meters.  up: (3,) toward the ceiling.
    Raises DependencyError (no off-screen rendering).
    """
    drawn = np.any([grid.labels > 0 for grid in grids.values()], axis=0)
    if not drawn.any():
        return {}
    centers = origin + (np.argwhere(drawn) + 0.5) * voxel_size
    R = turn_upright(up, centers)
    turned = centers @ R.T
    top = choose_cut_height(turned[:, 2], voxel_size)
    low = turned[turned[:, 2] <= top]
    first = next(iter(grids.values()))
    framed = DrawnScene(low, np.zeros((0, 4), np.int32), np.zeros((0, 3), np.uint8), first.path @ R.T)
    pictures = {}
    for name, grid in grids.items():
        voxels = np.argwhere(grid.labels)
        voxels = voxels[(origin + (voxels + 0.5) * voxel_size) @ R[2] <= top]
        corners, quads, rows = build_faces(voxels)
        vertices = (origin + corners * voxel_size) @ R.T
        colors = grid.colors[grid.labels[tuple(voxels[rows].T)]]
        scene = DrawnScene(vertices, quads, shade_faces(vertices, colors), grid.path @ R.T)
        views = np.vstack([render_scene(scene, aim(framed, view, SIZE)) for view in VIEWS])
        pictures[name] = cv2.imencode(".png", views[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 9])[1].tobytes()
    return pictures
