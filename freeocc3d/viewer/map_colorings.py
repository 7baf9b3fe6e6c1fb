"""What a picture of a map shows: the colors of the voxels, the regions with their names, and the legend."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..core.errors import ExportError
from ..query.regions import Region
from ..query.scan_map import Map
from ..query.word_query import QueryResult
from .palette import assign_class_colors, color_by_height, highlight_regions, word_colors

Color = tuple[int, int, int]

_LONGEST_NAME = 48  # characters of a word in the legend
_PATH, _FAINT_PATH = (26, 77, 230), (70, 70, 70)


@dataclass(frozen=True)
class MapColoring:
    """colors: (V, 3) uint8 RGB of the occupied voxels.  regions: each with a color and the name to write beside it.
    legend: texts with a color.  path_color: of the camera path."""

    colors: NDArray[np.uint8]
    regions: tuple[tuple[Region, Color, str], ...] = ()
    legend: tuple[tuple[str, Color], ...] = ()
    path_color: Color = _PATH


def color_map(scan_map: Map, by: str = "rgb") -> MapColoring:
    """Colors the map by "rgb", "class" or "height". Raises ExportError: an empty map, or an unknown coloring."""
    _refuse_empty(scan_map)
    occupancy = scan_map.occupancy
    if by == "rgb":
        return MapColoring(occupancy.colors)
    if by == "height":
        return MapColoring(color_by_height(occupancy, scan_map.up))
    if by != "class":
        raise ExportError(f"A map can be colored by rgb, class or height, not by '{by}'.")
    palette, labels = assign_class_colors(scan_map.vocabulary), scan_map.labels()
    present = np.bincount(labels, minlength=len(palette))
    common = [int(k) for k in np.argsort(-present, kind="stable") if present[k]]
    names = ["nothing known", *scan_map.vocabulary]
    legend = tuple((names[k], tuple(palette[k].tolist())) for k in common)
    return MapColoring(palette[labels], (), legend)


def color_answers(scan_map: Map, results: Sequence[QueryResult]) -> MapColoring:
    """Colors the map pale, and the regions of each word strongly. Raises ExportError for an empty map."""
    _refuse_empty(scan_map)
    found = [result.regions for result in results]
    legend, regions = [], []
    for result, chosen in sorted(zip(results, word_colors(found), strict=True), key=lambda pair: not pair[0].regions):
        color = tuple(chosen.tolist())
        legend.append((_found(result), color))
        regions += [(region, color, result.word) for region in result.regions]
    colors = highlight_regions(scan_map.occupancy.colors, found)
    return MapColoring(colors, tuple(regions), tuple(legend), _FAINT_PATH)


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
