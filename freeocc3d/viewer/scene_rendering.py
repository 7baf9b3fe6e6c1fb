"""Renders colored faces, a camera path and boxes off-screen from two sides with PyVista."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.errors import DependencyError

CUT = 0.8
"""Share of the height that is drawn. What is higher is left out, so that the rooms are open from above."""

BACKGROUND = (250, 250, 250)
VIEWS = ("above", "corner")

_BOX_EDGES = [(a, b) for a in range(8) for b in range(a + 1, 8) if (a ^ b) in (1, 2, 4)]


@dataclass(frozen=True)
class DrawnScene:
    """The things to draw, turned so that z is up: colored quads, a path, boxes."""

    vertices: NDArray[np.float64]  # (4 F, 3)
    quads: NDArray[np.int32]
    colors: NDArray[np.uint8]  # (F, 3)
    path: NDArray[np.float64]  # (P, 3) camera path
    boxes: tuple[tuple[NDArray[np.float64], tuple[int, int, int]], ...] = ()  # (8, 3) corners and a color


def turn_upright(up: NDArray[np.float64], points: NDArray[np.floating]) -> NDArray[np.float64]:
    """Returns the (3, 3) rotation that takes ``up`` to z, and the longer horizontal extent of (N, 3) points to x."""
    z = up / np.linalg.norm(up)
    x = np.cross(z, np.eye(3)[np.argmin(np.abs(z))])
    x /= np.linalg.norm(x)
    R = np.stack((x, np.cross(z, x), z))
    flat = (points @ R.T)[:, :2]
    angles = np.deg2rad(np.arange(0, 90, 3))
    directions = np.stack((np.cos(angles), np.sin(angles)), axis=1)
    across = np.stack((-directions[:, 1], directions[:, 0]), axis=1)
    extents = np.ptp(flat @ directions.T, axis=0), np.ptp(flat @ across.T, axis=0)
    best = int(np.argmin(extents[0] * extents[1]))
    along = directions[best] if extents[0][best] >= extents[1][best] else across[best]
    turn = np.array(((along[0], along[1], 0), (-along[1], along[0], 0), (0, 0, 1.0)))
    return turn @ R


def turn_lengthwise(R: NDArray[np.float64], points: NDArray[np.floating]) -> NDArray[np.float64]:
    """Returns R, a (3, 3) rotation to a frame with z up and walls along x and y, with a quarter turn if the (N, 3)
    points would otherwise reach farther along y than along x."""
    x, y = np.ptp(points @ R[:2].T, axis=0)
    return R if x >= y else np.array(((0, 1, 0), (-1, 0, 0), (0, 0, 1.0))) @ R


def choose_cut_height(height: NDArray[np.floating], voxel_size: float) -> float:
    """Returns the height up to which voxels are drawn, from (V,) heights of voxel centers: well below the ceiling."""
    low, high = np.percentile(height, (1, 99))
    return float(low + CUT * (high - low) + 0.5 * voxel_size)


def shade_faces(vertices: NDArray[np.float64], colors: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Returns the (F, 3) colors of faces, (4 F, 3) vertices with z up, under fixed lights, one from each direction. So
    the faces of a cube differ, and colors stay true."""
    corners = vertices.reshape(-1, 4, 3)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    light = 0.86 + 0.14 * normals[:, 2] + 0.07 * normals[:, 0] - 0.05 * normals[:, 1]
    return np.clip(colors * light[:, None], 0, 255).astype(np.uint8)


def render_scene(
    scene: DrawnScene, view: str, size: tuple[int, int], framed: DrawnScene | None = None
) -> NDArray[np.uint8]:
    """Returns the (H, W, 3) RGB of one of ``VIEWS``. size: (W, H) pixels.

    framed: the scene that fills the view, by default the drawn one; pictures to compare share it. Raises
    DependencyError (no off-screen rendering).
    """
    try:
        import pyvista
        import vtkmodules.vtkCommonCore as vtk

        vtk.vtkLogger.SetStderrVerbosity(vtk.vtkLogger.VERBOSITY_OFF)  # VTK reports every display that it does not find
    except ImportError as error:
        raise DependencyError(
            f"Pictures need pyvista with EGL and GL: run apt-get install libegl1 libgl1 ({error})."
        ) from None

    try:
        plotter = pyvista.Plotter(off_screen=True, window_size=list(size), lighting="none")
        plotter.set_background([c / 255 for c in BACKGROUND])
        if len(scene.quads):
            faces = np.concatenate((np.full((len(scene.quads), 1), 4, np.int64), scene.quads), axis=1).ravel()
            mesh = pyvista.PolyData(scene.vertices, faces)
            mesh.cell_data["rgb"] = scene.colors
            plotter.add_mesh(mesh, scalars="rgb", rgb=True, lighting=False)
        if len(scene.path) > 1:
            plotter.add_mesh(pyvista.lines_from_points(scene.path), color=(0.1, 0.3, 0.9), line_width=2)
        for corners, color in scene.boxes:
            edges = np.array([(2, a, b) for a, b in _BOX_EDGES]).ravel()
            box = pyvista.PolyData(corners, lines=edges)
            plotter.add_mesh(box, color=[c / 255 for c in color], line_width=2)
        _aim(plotter, framed or scene, view, size)
        image = plotter.screenshot(return_img=True)
        plotter.close()
    except Exception as error:
        raise DependencyError(f"Off-screen rendering failed: run apt-get install libegl1 libgl1 ({error}).") from error
    return np.asarray(image, np.uint8)[..., :3]


def _aim(plotter: Any, scene: DrawnScene, view: str, size: tuple[int, int]) -> None:
    """Aims the camera from straight above, or down into the scene from the corner nearest to the camera path. All boxes
    and all but a few stray voxels fill the view. Both views are parallel projections: equal lengths look equal."""
    points, path = scene.vertices, scene.path
    middle = 0.5 * (np.percentile(points, 1, axis=0) + np.percentile(points, 99, axis=0))
    if view == "above":
        back, up = np.array((0.0, 0.0, 1.0)), np.array((0.0, 1.0, 0.0))
    else:
        towards = (path.mean(axis=0) - middle)[:2] if len(path) else np.array((-1.0, -1.0))
        back, up = np.array((*np.where(towards >= 0, 0.6, -0.6), 1.0)), np.array((0.0, 0.0, 1.0))
    right = np.cross(up, back)
    axes = np.stack((right / np.linalg.norm(right), np.cross(back, right) / np.linalg.norm(np.cross(back, right))))
    spread = (points - middle) @ axes.T
    low, high = _bounds(spread, scene)
    for corners, _ in scene.boxes:  # the view holds what a word asks for, however far away it is
        at = (corners - middle) @ axes.T
        low, high = np.minimum(low, at.min(axis=0)), np.maximum(high, at.max(axis=0))
    half = 0.5 * (high - low)
    focus = middle + 0.5 * (low + high) @ axes
    plotter.camera.focal_point = focus
    plotter.camera.position = focus + back / np.linalg.norm(back) * (100.0 + np.linalg.norm(np.ptp(points, axis=0)))
    plotter.camera.up = up
    plotter.camera.parallel_projection = True
    plotter.camera.parallel_scale = 1.06 * max(half[1], half[0] * size[1] / size[0], 1e-3)
    plotter.reset_camera_clipping_range()


def _bounds(spread: NDArray[np.float64], scene: DrawnScene) -> tuple[NDArray[np.float64], ...]:
    """Returns the (2,) lower and (2,) upper bounds of the scene's faces in the view, without 0.3 % of their area on
    each side; the bounds of its points if it has no faces. spread: the vertices in the view."""
    weights = np.ones(len(spread))
    if len(scene.quads):
        corners = scene.vertices.reshape(-1, 4, 3)
        weights = np.repeat(((corners[:, 2] - corners[:, 0]) ** 2).sum(axis=1), 4)
    order = np.argsort(spread, axis=0)
    up_to = np.cumsum(weights[order], axis=0)
    ends = (np.count_nonzero(up_to < share * up_to[-1], axis=0) for share in (0.003, 0.997))
    return tuple(np.take_along_axis(spread, np.take_along_axis(order, end[None], 0), 0)[0] for end in ends)
