"""A map as a scene to draw: voxels, camera path and boxes, and the Gaussians beside them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..core.transforms import transform
from ..occupancy.surface_faces import find_exposed_faces
from ..query.oriented_boxes import OrientedBox
from ..query.scan_map import Map
from .map_colorings import MapColoring
from .names_on_things import NamePlaces, draw_edges, write_label
from .scene_rendering import (
    DrawnBox,
    DrawnScene,
    ViewCamera,
    choose_cut_height,
    open_renderer,
    shade_faces,
    turn_lengthwise,
)


@dataclass(frozen=True)
class MapScene:
    """drawn: voxels, path and boxes, in a frame with z up and the walls along x and y.  R_scene_map: (3, 3) from the
    map's frame to that one.  cut: height in it above which nothing is drawn; infinite if all is."""

    drawn: DrawnScene
    R_scene_map: NDArray[np.float64]
    cut: float


def build_scene(scan_map: Map, coloring: MapColoring, seen_from: NDArray[np.float64] | None = None) -> MapScene:
    """Returns the exposed faces of the voxels below the cut, and of the regions that lie mostly above it. seen_from:
    (3,) the camera's place, map frame; nothing is cut away for one that is below the cut."""
    occupancy = scan_map.occupancy
    centers = occupancy.centers(occupancy.occupied_voxels(), occupancy.occupied_edges())
    R = turn_lengthwise(scan_map.T_gravity_map[:3, :3], centers)
    height = centers @ R[2]
    cut = choose_cut_height(height, occupancy.voxel_size)
    if seen_from is not None and seen_from @ R[2] <= cut:
        cut = np.inf
    kept = height <= cut
    for region, _, _ in coloring.regions:  # draws a lamp that a word asks for; such a wall must not hide the room
        if 2 * np.count_nonzero(kept[region.rows]) < len(region.rows):
            kept[region.rows] = True
    vertices, quads, rows = find_exposed_faces(occupancy, kept)
    turned = vertices.astype(np.float64) @ R.T
    trajectory = scan_map.trajectory
    way = trajectory.T_world_cam[trajectory.has_pose][:, :3, 3] @ R.T
    upright = scan_map.boxes_of([region for region, _, _ in coloring.regions])
    boxes = tuple(
        DrawnBox(_corners(box) @ R.T, color, name)
        for box, (_, color, name) in zip(upright, coloring.regions, strict=True)
    )
    colors = shade_faces(turned, coloring.colors[rows])
    return MapScene(DrawnScene(turned, quads, colors, way, boxes, coloring.path_color), R, float(cut))


@contextmanager
def open_panels(
    scan_map: Map, scene: MapScene, size: tuple[int, int], with_gaussians: bool
) -> Iterator[Callable[[ViewCamera], NDArray[np.uint8]]]:
    """Gives a function that draws the voxels, and the Gaussians to their right if asked, with names on the boxes:
    (H, W or 2 W, 3) RGB. size: (W, H) pixels of one of the two. Raises DependencyError, as ``open_renderer`` does."""
    painter = None
    if with_gaussians:
        from .gaussian_views import GaussianPainter

        below = scan_map.gaussians.means @ scene.R_scene_map[2] <= scene.cut
        painter = GaussianPainter(scan_map.gaussians[below], scene.R_scene_map)
    names = NamePlaces(scene.drawn.boxes)
    with open_renderer(scene.drawn, size) as render:

        def draw(camera: ViewCamera) -> NDArray[np.uint8]:
            panels = {"voxels": render(camera)}
            if painter is not None:
                panels["Gaussians"] = painter.draw(camera)
            names.choose(camera)
            for title, panel in panels.items():
                for box in scene.drawn.boxes:
                    draw_edges(panel, box, camera, 1 if title == "voxels" else 2)
                names.write(panel)
                if len(panels) > 1:
                    write_label(panel, title, (10, 8))
            return np.hstack(list(panels.values()))

        yield draw


def _corners(box: OrientedBox) -> NDArray[np.float64]:
    """Returns the (8, 3) corners, map frame."""
    return transform(box.T_map_box, (np.indices((2, 2, 2)).reshape(3, -1).T - 0.5) * box.extent)
