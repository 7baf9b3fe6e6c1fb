"""Renders colored faces and a camera path off-screen with PyVista."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..core.errors import DependencyError
from ..core.transforms import invert
from ..core.types import Intrinsics

CUT = 0.8
"""Share of the height that is drawn. What is higher is left out, so that the rooms are open from above."""

BACKGROUND = (250, 250, 250)
NEAR_M = 0.02
"""What is nearer to a camera is not drawn."""


class DrawnBox(NamedTuple):
    """A box to draw: (8, 3) corners, the last axis running fastest; RGB; the name to write beside it, or ""."""

    corners: NDArray[np.float64]
    color: tuple[int, int, int]
    name: str = ""


@dataclass(frozen=True)
class DrawnScene:
    """The things to draw, turned so that z is up: colored quads, a path, boxes."""

    vertices: NDArray[np.float64]  # (4 F, 3)
    quads: NDArray[np.int32]
    colors: NDArray[np.uint8]  # (F, 3)
    path: NDArray[np.float64]  # (P, 3) camera path
    boxes: tuple[DrawnBox, ...] = ()
    path_color: tuple[int, int, int] = (26, 77, 230)


@dataclass(frozen=True)
class ViewCamera:
    """Where a picture is seen from.

    T_cam_scene: (4, 4), the camera's x is right, y down, z forward.  intrinsics: focal length and center, pixels.
    distance: None for a perspective. For a parallel projection, of the place whose scale the picture has: it is so far
    away that the pinhole shows almost the same.
    """

    T_cam_scene: NDArray[np.float64]
    intrinsics: Intrinsics
    distance: float | None = None


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


@contextmanager
def open_renderer(scene: DrawnScene, size: tuple[int, int]) -> Iterator[Callable[[ViewCamera], NDArray[np.uint8]]]:
    """Gives a function that renders the scene as cameras with images of one size see it: (H, W, 3) RGB. size: (W, H)
    pixels. Raises DependencyError (no off-screen rendering), as the function does."""
    try:
        import pyvista
        import vtkmodules.vtkCommonCore as vtk

        vtk.vtkLogger.SetStderrVerbosity(vtk.vtkLogger.VERBOSITY_OFF)  # VTK reports every display that it does not find
    except ImportError as error:
        raise DependencyError(
            f"Pictures need pyvista with EGL and GL: run apt-get install libegl1 libgl1 ({error})."
        ) from None

    with _rendering():
        plotter = pyvista.Plotter(off_screen=True, window_size=list(size), lighting="none")
        _fill(plotter, scene)

    def render(camera: ViewCamera) -> NDArray[np.uint8]:
        with _rendering():
            _aim(plotter, camera)
            plotter.render()
            return np.array(plotter.screenshot(return_img=True), np.uint8)[..., :3]

    try:
        yield render
    finally:
        plotter.close()


def render_scene(scene: DrawnScene, camera: ViewCamera) -> NDArray[np.uint8]:
    """Returns the (H, W, 3) RGB of one view, as ``open_renderer`` does."""
    with open_renderer(scene, (camera.intrinsics.width, camera.intrinsics.height)) as render:
        return render(camera)


@contextmanager
def _rendering() -> Iterator[None]:
    try:
        yield
    except Exception as error:
        raise DependencyError(f"Off-screen rendering failed: run apt-get install libegl1 libgl1 ({error}).") from error


def _fill(plotter: Any, scene: DrawnScene) -> None:
    import pyvista

    plotter.set_background([c / 255 for c in BACKGROUND])
    if len(scene.quads):
        faces = np.concatenate((np.full((len(scene.quads), 1), 4, np.int64), scene.quads), axis=1).ravel()
        mesh = pyvista.PolyData(scene.vertices, faces)
        mesh.cell_data["rgb"] = scene.colors
        plotter.add_mesh(mesh, scalars="rgb", rgb=True, lighting=False)
    if len(scene.path) > 1:
        color = [c / 255 for c in scene.path_color]
        plotter.add_mesh(pyvista.lines_from_points(scene.path), color=color, line_width=2)


def _aim(plotter: Any, camera: ViewCamera) -> None:
    T_scene_cam = invert(camera.T_cam_scene)
    _, y, forward, position = T_scene_cam[:3].T
    plotter.camera.position = position
    plotter.camera.focal_point = position + forward * (camera.distance or 1.0)
    plotter.camera.up = -y
    half, focal = 0.5 * camera.intrinsics.height, camera.intrinsics.fy
    if camera.distance is not None:
        plotter.camera.parallel_projection = True
        plotter.camera.parallel_scale = half * camera.distance / focal
    else:
        plotter.camera.view_angle = 2 * np.degrees(np.arctan(half / focal))
    plotter.reset_camera_clipping_range()
    if camera.distance is None:
        plotter.camera.clipping_range = NEAR_M, max(plotter.camera.clipping_range[1], 1.0)
