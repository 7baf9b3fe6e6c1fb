"""Draws pictures of a map, from above and from a corner, off-screen with PyVista."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.atomic_files import write_whole
from ..core.errors import ExportError
from ..core.transforms import transform
from ..occupancy.surface_faces import find_exposed_faces
from ..query.oriented_boxes import OrientedBox
from ..query.regions import Region
from ..query.scan_map import Map
from ..query.word_query import QueryResult
from .distinct_colors import distinct_colors
from .lettering import HEADING, LEGEND, measure_text, write_text
from .palette import assign_class_colors, color_by_height, highlight_regions
from .scene_rendering import (
    BACKGROUND,
    CUT,
    VIEWS,
    DrawnScene,
    choose_cut_height,
    render_scene,
    shade_faces,
    turn_lengthwise,
)

SIZE = 1600, 900
_BAR = 56  # pixels above and below the views
_LEGEND_ROWS = 2
_LONGEST_NAME = 48  # characters of a word in the legend
_MARGIN, _SWATCH, _GAP, _MORE = 16, 22, 20, 130  # pixels: left edge, box before a name, after it, room for "and N more"


def write_map_picture(scan_map: Map, path: str | Path, by: str = "rgb", overwrite: bool = False) -> None:
    """Draws the map colored by "rgb", "class" or "height", with the camera path, as PNG.

    Raises ExportError (empty map, unwritable target, unknown coloring), DependencyError (no off-screen rendering).
    """
    _refuse_empty(scan_map)
    occupancy = scan_map.occupancy
    legend: list[tuple[str, tuple[int, int, int]]] = []
    if by == "rgb":
        colors = occupancy.colors
    elif by == "class":
        palette, labels = assign_class_colors(scan_map.vocabulary), scan_map.labels()
        colors = palette[labels]
        present = np.bincount(labels, minlength=len(palette))
        common = [int(k) for k in np.argsort(-present, kind="stable") if present[k]]
        names = ["nothing known", *scan_map.vocabulary]
        legend = [(names[k], tuple(palette[k].tolist())) for k in common]
    elif by == "height":
        colors = color_by_height(occupancy, scan_map.up)
    else:
        raise ExportError(f"A map can be colored by rgb, class or height, not by '{by}'.")
    _write(_drawn(scan_map, colors, [], _title(scan_map), legend), Path(path), overwrite)


def write_query_picture(
    scan_map: Map, results: Sequence[QueryResult], path: str | Path, overwrite: bool = False
) -> None:
    """Draws the map in pale colors, and the regions of each word in a strong color with boxes, as PNG. Raises as
    ``write_map_picture`` does."""
    _write(draw_query(scan_map, results), Path(path), overwrite)


def draw_query(scan_map: Map, results: Sequence[QueryResult]) -> bytes:
    """Returns the PNG that ``write_query_picture`` writes."""
    _refuse_empty(scan_map)
    colors = highlight_regions(scan_map.occupancy.colors, [result.regions for result in results])
    legend = []
    boxes: list[tuple[Region, tuple[int, int, int]]] = []
    for result, chosen in zip(results, distinct_colors(len(results)), strict=True):
        color = tuple(chosen.tolist())
        legend.append((_found(result), color))
        boxes += [(region, color) for region in result.regions]
    return _drawn(scan_map, colors, boxes, _title(scan_map), legend)


def _found(result: QueryResult) -> str:
    """Returns the legend's text for a word: the number of regions, and the best score."""
    word = result.word if len(result.word) <= _LONGEST_NAME else result.word[: _LONGEST_NAME - 3] + "..."
    if not result.regions:
        return f"{word}: no match"
    count, best = len(result.regions), f"{result.regions[0].score:.2f}"
    return f"{word}: {count} regions, best {best}" if count > 1 else f"{word}: 1 region, {best}"


def _refuse_empty(scan_map: Map) -> None:
    if len(scan_map.occupancy.colors) == 0:
        raise ExportError(f"The map {scan_map.path} has no occupied voxels to draw.")


def _write(png: bytes, path: Path, overwrite: bool) -> None:
    if path.suffix.lower() != ".png":
        raise ExportError(f"Pictures are written as PNG: use the name {path.with_suffix('.png')} in place of {path}.")
    write_whole(path, lambda target: _write_bytes(target, png), overwrite)


def _drawn(
    scan_map: Map,
    colors: NDArray[np.uint8],
    regions: list[tuple[Region, tuple[int, int, int]]],
    title: str,
    legend: list[tuple[str, tuple[int, int, int]]],
) -> bytes:
    """Returns the picture as PNG."""
    scene = _scene(scan_map, colors, regions)
    width, height = SIZE[0] // 2, SIZE[1] - 2 * _BAR
    views = np.hstack([render_scene(scene, view, (width, height)) for view in VIEWS])
    picture = _framed(views, title, legend)
    return bytes(cv2.imencode(".png", picture[..., ::-1])[1])


def _write_bytes(path: Path, data: bytes) -> None:
    path.write_bytes(data)


def _scene(scan_map: Map, colors: NDArray[np.uint8], regions: list[tuple[Region, tuple[int, int, int]]]) -> DrawnScene:
    """Returns the exposed faces of the voxels below the cut, and of the regions that lie mostly above it, turned so
    that z is up and the walls lie along x and y."""
    occupancy = scan_map.occupancy
    centers = occupancy.centers(occupancy.occupied_voxels(), occupancy.occupied_edges())
    R = turn_lengthwise(scan_map.T_gravity_map[:3, :3], centers)
    height = centers @ R[2]
    kept = height <= choose_cut_height(height, occupancy.voxel_size)
    for (
        region,
        _,
    ) in regions:  # draws a lamp that a word asks for; such a wall must not hide the room
        if 2 * np.count_nonzero(kept[region.rows]) < len(region.rows):
            kept[region.rows] = True
    vertices, quads, rows = find_exposed_faces(occupancy, kept)
    turned = vertices.astype(np.float64) @ R.T
    trajectory = scan_map.trajectory
    way = trajectory.T_world_cam[trajectory.has_pose][:, :3, 3] @ R.T
    upright = scan_map.boxes_of([region for region, _ in regions])
    boxes = tuple((_corners(box) @ R.T, color) for box, (_, color) in zip(upright, regions, strict=True))
    return DrawnScene(turned, quads, shade_faces(turned, colors[rows]), way, boxes)


def _corners(box: OrientedBox) -> NDArray[np.float64]:
    """Returns the (8, 3) corners, map frame."""
    return transform(box.T_map_box, (np.indices((2, 2, 2)).reshape(3, -1).T - 0.5) * box.extent)


def _framed(views: NDArray[np.uint8], title: str, legend: list[tuple[str, tuple[int, int, int]]]) -> NDArray[np.uint8]:
    """Returns the views with the title above and the legend below."""
    picture = np.full((SIZE[1], SIZE[0], 3), BACKGROUND, np.uint8)
    picture[_BAR : _BAR + views.shape[0], : views.shape[1]] = views
    write_text(picture, title, (16, 36), HEADING)
    widths = [_SWATCH + measure_text(text, LEGEND) for text, _ in legend]
    places = _placed(widths)
    baselines = (SIZE[1] - 20,) if not places or places[-1][0] == 0 else (SIZE[1] - 36, SIZE[1] - 12)
    for (text, color), (row, x) in zip(legend, places, strict=False):
        y = baselines[row]
        cv2.rectangle(picture, (x, y - 14), (x + 16, y + 2), color, -1, cv2.LINE_AA)
        write_text(picture, text, (x + _SWATCH, y), LEGEND)
    if left_out := len(legend) - len(places):
        write_text(picture, f"and {left_out} more", (SIZE[0] - _MORE, baselines[-1]), LEGEND)
    return picture


def _placed(widths: list[int]) -> list[tuple[int, int]]:
    """Returns (row, x) of the legend's entries that fit. The last row keeps room for "and N more"."""
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


def _size(scan_map: Map) -> str:
    """Returns the text of the voxel size, with its unit."""
    factor, unit = (100, "cm") if scan_map.metric else (1, "units")
    largest, smallest = factor * scan_map.occupancy.voxel_size, factor * scan_map.occupancy.finest
    return f"{largest:.3g} {unit}" if largest == smallest else f"{largest:.3g} to {smallest:.3g} {unit}"


def _title(scan_map: Map) -> str:
    counts = scan_map.manifest.counts
    name = Path(scan_map.manifest.capture.path).name
    return (
        f"{name}: {counts.voxels.occupied:,} occupied voxels of {_size(scan_map)}, "
        f"{counts.frames_with_pose} of {counts.frames} frames; above {CUT:.0%} of the height is cut away"
    )
