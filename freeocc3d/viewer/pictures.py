"""Pictures of a map, from above and from a corner, drawn off-screen with PyVista."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..errors import DependencyError, ExportError, FreeOccError
from ..files import write_whole
from ..occupancy.faces import exposed_faces
from ..palette import HIGHLIGHTS, class_colors, height_colors, highlighted
from ..query import QueryResult, Region
from ..store import Map
from ..types import Occupancy

SIZE = 1600, 900
CUT = 0.8
"""What is higher than this share of the map's height is left out, so that one looks into the rooms; a region that lies
mostly above it is drawn all the same."""

_BAR = 56  # pixels above and below the views
_BACKGROUND = (250, 250, 250)
_TEXT = (40, 40, 40)
_LEGEND_ROWS = 2
_LONGEST_NAME = 48  # characters of a word in the legend
_MARGIN, _SWATCH, _GAP, _MORE = 16, 22, 20, 130  # pixels: left edge, box before a name, after it, room for "and N more"


@dataclass(frozen=True)
class _Scene:
    """What is drawn, turned so that z is up: quads with a colour each, lines, boxes."""

    vertices: NDArray[np.float64]  # (4 F, 3)
    quads: NDArray[np.int32]
    colors: NDArray[np.uint8]  # (F, 3)
    path: NDArray[np.float64]  # (P, 3) the camera's way
    boxes: list[tuple[NDArray[np.float64], tuple[int, int, int]]]  # (8, 3) corners and a colour


def map_picture(scan_map: Map, path: str | Path, by: str = "rgb", overwrite: bool = False) -> None:
    """Draw the map coloured by "rgb", "class" or "height", with the camera's way, as PNG.

    Raises ExportError (empty map, unwritable target, unknown colouring), DependencyError (no off-screen rendering).
    """
    _refuse_empty(scan_map)
    occupancy = scan_map.occupancy
    legend: list[tuple[str, tuple[int, int, int]]] = []
    if by == "rgb":
        colors = occupancy.colors
    elif by == "class":
        palette, labels = class_colors(scan_map.vocabulary), scan_map.labels()
        colors = palette[labels]
        present = np.bincount(labels, minlength=len(palette))
        common = [int(k) for k in np.argsort(-present, kind="stable") if present[k]]
        names = ["nothing known", *scan_map.vocabulary]
        legend = [(names[k], tuple(palette[k].tolist())) for k in common]
    elif by == "height":
        colors = height_colors(occupancy, scan_map.up)
    else:
        raise ExportError(f"A map can be coloured by rgb, class or height, not by '{by}'.")
    _draw(scan_map, colors, [], _title(scan_map), legend, Path(path), overwrite)


def query_picture(scan_map: Map, results: Sequence[QueryResult], path: str | Path, overwrite: bool = False) -> None:
    """Draw the map pale with what each word matched in a strong colour, boxed; PNG. Raises as ``map_picture``."""
    _refuse_empty(scan_map)
    colors = highlighted(scan_map.occupancy.colors, [result.regions for result in results])
    legend = []
    boxes: list[tuple[Region, tuple[int, int, int]]] = []
    for number, result in enumerate(results):
        color = tuple(HIGHLIGHTS[number % len(HIGHLIGHTS)].tolist())
        legend.append((_found(result), color))
        boxes += [(region, color) for region in result.regions]
    _draw(scan_map, colors, boxes, _title(scan_map), legend, Path(path), overwrite)


def _found(result: QueryResult) -> str:
    """What the legend says of a word: how many regions, and the score of the best."""
    word = result.word if len(result.word) <= _LONGEST_NAME else result.word[: _LONGEST_NAME - 3] + "..."
    if not result.regions:
        return f"{word}: no match"
    count, best = len(result.regions), f"{result.regions[0].score:.2f}"
    return f"{word}: {count} regions, best {best}" if count > 1 else f"{word}: 1 region, {best}"


def _refuse_empty(scan_map: Map) -> None:
    if len(scan_map.occupancy.colors) == 0:
        raise ExportError(f"The map {scan_map.path} has no occupied voxel to draw.")


def _draw(
    scan_map: Map,
    colors: NDArray[np.uint8],
    regions: list[tuple[Region, tuple[int, int, int]]],
    title: str,
    legend: list[tuple[str, tuple[int, int, int]]],
    path: Path,
    overwrite: bool,
) -> None:
    if path.suffix.lower() != ".png":
        raise ExportError(f"Pictures are written as PNG: name it {path.with_suffix('.png')} in place of {path}.")
    scene = _scene(scan_map, colors, regions)
    width, height = SIZE[0] // 2, SIZE[1] - 2 * _BAR
    views = np.hstack([_render(scene, view, (width, height)) for view in ("above", "corner")])
    picture = _framed(views, title, legend)
    encoded = cv2.imencode(".png", picture[..., ::-1])[1].tobytes()
    write_whole(path, lambda target: _write_bytes(target, encoded), overwrite)


def _write_bytes(path: Path, data: bytes) -> None:
    path.write_bytes(data)


def _scene(scan_map: Map, colors: NDArray[np.uint8], regions: list[tuple[Region, tuple[int, int, int]]]) -> _Scene:
    """The exposed faces of the voxels below the cut and of the regions that lie mostly above it, turned so that z is up
    and the longer walls lie along x."""
    occupancy = scan_map.occupancy
    R = _upright(scan_map.up, occupancy)
    kept = _below_cut(occupancy, R)
    for region, _ in regions:  # a lamp that was asked for is drawn; a wall that was asked for does not hide the room
        if 2 * np.count_nonzero(kept[region.rows]) < len(region.rows):
            kept[region.rows] = True
    vertices, quads, rows = exposed_faces(occupancy, kept)
    turned = vertices.astype(np.float64) @ R.T
    corners = turned.reshape(-1, 4, 3)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    # A fixed light per direction: faces of a cube are told apart, and colours stay what they are.
    light = 0.86 + 0.14 * normals[:, 2] + 0.07 * normals[:, 0] - 0.05 * normals[:, 1]
    shaded = np.clip(colors[rows] * light[:, None], 0, 255).astype(np.uint8)
    trajectory = scan_map.trajectory
    way = trajectory.T_world_cam[trajectory.has_pose][:, :3, 3] @ R.T
    boxes = [(_corners(region) @ R.T, color) for region, color in regions]
    return _Scene(turned, quads, shaded, way, boxes)


def _upright(up: NDArray[np.float64], occupancy: Occupancy) -> NDArray[np.float64]:
    """(3, 3) rotation of the map's frame that takes ``up`` to z and the longer extent of the voxels to x."""
    z = up / np.linalg.norm(up)
    x = np.cross(z, np.eye(3)[np.argmin(np.abs(z))])
    x /= np.linalg.norm(x)
    R = np.stack((x, np.cross(z, x), z))
    flat = (occupancy.centers(occupancy.occupied_voxels()) @ R.T)[:, :2]
    angles = np.deg2rad(np.arange(0, 90, 3))
    directions = np.stack((np.cos(angles), np.sin(angles)), axis=1)
    across = np.stack((-directions[:, 1], directions[:, 0]), axis=1)
    extents = np.ptp(flat @ directions.T, axis=0), np.ptp(flat @ across.T, axis=0)
    best = int(np.argmin(extents[0] * extents[1]))
    along = directions[best] if extents[0][best] >= extents[1][best] else across[best]
    turn = np.array(((along[0], along[1], 0), (-along[1], along[0], 0), (0, 0, 1.0)))
    return turn @ R


def _below_cut(occupancy: Occupancy, R: NDArray[np.float64]) -> NDArray[np.bool_]:
    """(V,) occupied voxels that are not too near to the ceiling."""
    height = occupancy.centers(occupancy.occupied_voxels()) @ R[2]
    low, high = np.percentile(height, (1, 99))
    return np.asarray(height <= low + CUT * (high - low) + 0.5 * occupancy.voxel_size)


def _corners(region: Region) -> NDArray[np.float64]:
    """(8, 3) corners of a region's box."""
    choice = np.indices((2, 2, 2)).reshape(3, -1).T
    return np.where(choice == 0, region.box_min, region.box_max)


_BOX_EDGES = [(a, b) for a in range(8) for b in range(a + 1, 8) if (a ^ b) in (1, 2, 4)]


def _render(scene: _Scene, view: str, size: tuple[int, int]) -> NDArray[np.uint8]:
    """(H, W, 3) one view."""
    try:
        import pyvista
        import vtkmodules.vtkCommonCore as vtk

        vtk.vtkLogger.SetStderrVerbosity(vtk.vtkLogger.VERBOSITY_OFF)  # it reports every display that it does not find
    except ImportError as error:
        raise DependencyError(
            f"Pictures need pyvista with EGL and GL: apt-get install libegl1 libgl1 ({error})."
        ) from None

    try:
        plotter = pyvista.Plotter(off_screen=True, window_size=list(size), lighting="none")
        plotter.set_background([c / 255 for c in _BACKGROUND])
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
        _aim(plotter, scene, view, size)
        image = plotter.screenshot(return_img=True)
        plotter.close()
    except FreeOccError:
        raise
    except Exception as error:
        raise DependencyError(f"Off-screen rendering failed: apt-get install libegl1 libgl1 ({error}).") from error
    return np.asarray(image, np.uint8)[..., :3]


def _aim(plotter: Any, scene: _Scene, view: str, size: tuple[int, int]) -> None:
    """Look from straight above, or down into the scene from the diagonal on which the camera walked, such that all but
    a few stray voxels fill the view. Both views are parallel projections: equal lengths look equal."""
    middle = 0.5 * (np.percentile(scene.vertices, 1, axis=0) + np.percentile(scene.vertices, 99, axis=0))
    if view == "above":
        back, up = np.array((0.0, 0.0, 1.0)), np.array((0.0, 1.0, 0.0))
    else:
        towards = (scene.path.mean(axis=0) - middle)[:2] if len(scene.path) else np.array((-1.0, -1.0))
        back, up = np.array((*np.where(towards >= 0, 0.6, -0.6), 1.0)), np.array((0.0, 0.0, 1.0))
    right = np.cross(up, back)
    axes = np.stack((right / np.linalg.norm(right), np.cross(back, right) / np.linalg.norm(np.cross(back, right))))
    spread = (scene.vertices - middle) @ axes.T
    low, high = np.percentile(spread, 0.3, axis=0), np.percentile(spread, 99.7, axis=0)
    half = 0.5 * (high - low)
    focus = middle + 0.5 * (low + high) @ axes
    plotter.camera.focal_point = focus
    plotter.camera.position = focus + back / np.linalg.norm(back) * 100.0
    plotter.camera.up = up
    plotter.camera.parallel_projection = True
    plotter.camera.parallel_scale = 1.06 * max(half[1], half[0] * size[1] / size[0], 1e-3)
    plotter.reset_camera_clipping_range()


def _framed(views: NDArray[np.uint8], title: str, legend: list[tuple[str, tuple[int, int, int]]]) -> NDArray[np.uint8]:
    """The views with the title above and the legend below."""
    picture = np.full((SIZE[1], SIZE[0], 3), _BACKGROUND, np.uint8)
    picture[_BAR : _BAR + views.shape[0], : views.shape[1]] = views
    _put(picture, title, (16, 36), 0.62)
    widths = [_SWATCH + cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, 0.52, 1)[0][0] for text, _ in legend]
    places = _placed(widths)
    baselines = (SIZE[1] - 20,) if not places or places[-1][0] == 0 else (SIZE[1] - 36, SIZE[1] - 12)
    for (text, color), (row, x) in zip(legend, places, strict=False):
        y = baselines[row]
        cv2.rectangle(picture, (x, y - 14), (x + 16, y + 2), color, -1, cv2.LINE_AA)
        _put(picture, text, (x + _SWATCH, y), 0.52)
    if left_out := len(legend) - len(places):
        _put(picture, f"and {left_out} more", (SIZE[0] - _MORE, baselines[-1]), 0.52)
    return picture


def _placed(widths: list[int]) -> list[tuple[int, int]]:
    """(row, x) of the legend's entries, as many as its rows hold; the last row keeps room to count those left out."""
    places: list[tuple[int, int]] = []
    row, x = 0, _MARGIN
    for width in widths:
        while row < _LEGEND_ROWS and x + width > SIZE[0] - (_MORE if row == _LEGEND_ROWS - 1 else _MARGIN):
            row, x = row + 1, _MARGIN
        if row == _LEGEND_ROWS:
            break
        places.append((row, x))
        x += width + _GAP
    return places


def _put(picture: NDArray[np.uint8], text: str, at: tuple[int, int], scale: float) -> None:
    printable = text.encode("ascii", "replace").decode()
    cv2.putText(picture, printable, at, cv2.FONT_HERSHEY_SIMPLEX, scale, _TEXT, 1, cv2.LINE_AA)


def _title(scan_map: Map) -> str:
    counts = scan_map.manifest["counts"]
    name = Path(str(scan_map.manifest["capture"]["path"])).name
    return (
        f"{name}: {counts['voxels']['occupied']:,} occupied voxels of {100 * scan_map.occupancy.voxel_size:g} cm, "
        f"{counts['frames_with_pose']} of {counts['frames']} frames; above {CUT:.0%} of the height is cut away"
    )
