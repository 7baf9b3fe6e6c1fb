"""Draws pictures of a map, from above and from a corner or from any place, off-screen with PyVista."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core.atomic_files import write_whole
from ..core.errors import ExportError
from ..query.scan_map import Map
from ..query.word_query import QueryResult
from .lettering import HEADING, LEGEND, measure_text, write_text
from .map_colorings import Color, MapColoring, color_answers, color_map
from .map_scenes import build_scene, open_panels
from .scene_rendering import BACKGROUND, CUT
from .view_cameras import VIEWS, aim, aim_from, pixels_of

SIZE = 1600, 900
BAR = 56
"""Pixels above and below the views."""
_CUT_AWAY = f"; above {CUT:.0%} of the height is cut away"
_LEGEND_ROWS = 2
_MARGIN, _SWATCH, _GAP, _MORE = 16, 22, 20, 130  # pixels: left edge, box before a name, after it, room for "and N more"


def write_map_picture(scan_map: Map, path: str | Path, by: str = "rgb", overwrite: bool = False) -> None:
    """Draws the map colored by "rgb", "class" or "height", with the camera path, as PNG.

    Raises ExportError (empty map, unwritable target, unknown coloring), DependencyError (no off-screen rendering).
    """
    _write(draw_coloring(scan_map, color_map(scan_map, by)), Path(path), overwrite)


def write_query_picture(
    scan_map: Map, results: Sequence[QueryResult], path: str | Path, overwrite: bool = False
) -> None:
    """Draws the map in pale colors, and the regions of each word in a strong color with boxes, as PNG. Raises as
    ``write_map_picture`` does."""
    _write(draw_query(scan_map, results), Path(path), overwrite)


def write_both_picture(scan_map: Map, coloring: MapColoring, path: Path, overwrite: bool = False) -> None:
    """Draws the voxels and, to their right, the Gaussians, as PNG. Raises as ``write_map_picture`` does."""
    _write(draw_coloring(scan_map, coloring, has_gaussians(scan_map)), path, overwrite)


def write_place_picture(
    scan_map: Map, coloring: MapColoring, place: ArrayLike, target: ArrayLike, path: Path, overwrite: bool = False
) -> None:
    """Draws what one sees from a place towards another, (3,) in the map's frame, as voxels and as Gaussians. The
    ceiling is there if the place is below it. Raises as ``write_map_picture`` does, and ExportError for a place in an
    occupied voxel, or from which nothing is in view."""
    here, there = np.asarray(place, np.float64), np.asarray(target, np.float64)
    _refuse_place(scan_map, here, there)
    scene = build_scene(scan_map, coloring, here)
    both = has_gaussians(scan_map)
    size = SIZE[0] // (1 + both), SIZE[1] - 2 * BAR
    camera = aim_from(scene.R_scene_map @ here, scene.R_scene_map @ there, size)
    pixels, depth = pixels_of(scene.drawn.vertices, camera)
    seen = pixels[(depth > 0) & (pixels >= 0).all(axis=1) & (pixels < size).all(axis=1)]
    if not len(seen) or np.ptp(seen, axis=0).max() < 1:
        raise ExportError(f"Nothing of the map is in view from {_told(here)} towards {_told(there)}: choose others.")
    with open_panels(scan_map, scene, size, both) as draw:
        view = draw(camera)
    unit = "m" if scan_map.metric else "units"
    cut = _CUT_AWAY if np.isfinite(scene.cut) else ""
    title = f"{_name(scan_map)}, seen from {_told(here)} towards {_told(there)}, {unit} in the map's frame{cut}"
    _write(_encoded(frame_views(view, title, coloring.legend)), path, overwrite)


def draw_query(scan_map: Map, results: Sequence[QueryResult]) -> bytes:
    """Returns the PNG that ``write_query_picture`` writes."""
    return draw_coloring(scan_map, color_answers(scan_map, results))


def draw_coloring(scan_map: Map, coloring: MapColoring, with_gaussians: bool = False) -> bytes:
    """Returns a PNG of the two ``VIEWS`` beside each other; with Gaussians, below each other, and these to the
    right."""
    scene = build_scene(scan_map, coloring)
    size = SIZE[0] // 2, 620 if with_gaussians else SIZE[1] - 2 * BAR
    with open_panels(scan_map, scene, size, with_gaussians) as draw:
        views = [draw(aim(scene.drawn, view, size)) for view in VIEWS]
    stacked = np.vstack(views) if with_gaussians else np.hstack(views)
    return _encoded(frame_views(stacked, map_title(scan_map), coloring.legend))


def has_gaussians(scan_map: Map) -> bool:
    """Whether there are Gaussians to draw."""
    return scan_map.manifest.counts.gaussians > 0


def _refuse_place(scan_map: Map, place: NDArray[np.float64], target: NDArray[np.float64]) -> None:
    """Raises ExportError."""
    if not np.isfinite((place, target)).all():
        raise ExportError("A place is three finite numbers, x, y and z in the map's frame.")
    if np.linalg.norm(target - place) < 1e-6:
        raise ExportError(f"One cannot look from {_told(place)} towards the same place: choose another one to look at.")
    occupancy = scan_map.occupancy
    corner = (place - occupancy.origin) / occupancy.finest - occupancy.occupied_voxels()
    if ((corner >= 0) & (corner < occupancy.occupied_edges()[:, None])).all(axis=1).any():
        raise ExportError(f"The place {_told(place)} is inside an occupied voxel: choose one in free space.")


def _told(place: NDArray[np.float64]) -> str:
    return "(" + ", ".join(f"{value:.4g}" for value in place) + ")"


def _write(png: bytes, path: Path, overwrite: bool) -> None:
    if path.suffix.lower() != ".png":
        raise ExportError(f"Pictures are written as PNG: use the name {path.with_suffix('.png')} in place of {path}.")
    write_whole(path, lambda target: _write_bytes(target, png), overwrite)


def _encoded(picture: NDArray[np.uint8]) -> bytes:
    return bytes(cv2.imencode(".png", picture[..., ::-1])[1])


def _write_bytes(path: Path, data: bytes) -> None:
    path.write_bytes(data)


def frame_views(views: NDArray[np.uint8], title: str, legend: Sequence[tuple[str, Color]]) -> NDArray[np.uint8]:
    """Returns the views with the title above and the legend below."""
    height, width = views.shape[0] + 2 * BAR, views.shape[1]
    picture = np.full((height, width, 3), BACKGROUND, np.uint8)
    picture[BAR:-BAR] = views
    write_text(picture, title, (16, 36), HEADING)
    widths = [_SWATCH + measure_text(text, LEGEND) for text, _ in legend]
    places = _placed(widths, width)
    baselines = (height - 20,) if not places or places[-1][0] == 0 else (height - 36, height - 12)
    for (text, color), (row, x) in zip(legend, places, strict=False):
        y = baselines[row]
        cv2.rectangle(picture, (x, y - 14), (x + 16, y + 2), color, -1, cv2.LINE_AA)
        write_text(picture, text, (x + _SWATCH, y), LEGEND)
    if left_out := len(legend) - len(places):
        write_text(picture, f"and {left_out} more", (width - _MORE, baselines[-1]), LEGEND)
    return picture


def _placed(widths: list[int], room: int = SIZE[0]) -> list[tuple[int, int]]:
    """Returns (row, x) of the legend's entries that fit. The last row keeps room for "and N more"."""
    places: list[tuple[int, int]] = []
    row, x = 0, _MARGIN
    for width in widths:
        while row < _LEGEND_ROWS and x + width > room - (_MORE if row == _LEGEND_ROWS - 1 else _MARGIN):
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


def _name(scan_map: Map) -> str:
    return Path(scan_map.manifest.capture.path).name


def map_title(scan_map: Map) -> str:
    """Returns the heading of a picture that is cut below the ceiling."""
    counts = scan_map.manifest.counts
    return (
        f"{_name(scan_map)}: {counts.voxels.occupied:,} occupied voxels of {_size(scan_map)}, "
        f"{counts.frames_with_pose} of {counts.frames} frames{_CUT_AWAY}"
    )
