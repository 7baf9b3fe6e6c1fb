"""GeoJSON: the regions of words as outlines on the floor, for maps and fleet managers.

A FeatureCollection with one Polygon for each region: the convex outline of its voxels seen from above, x and y in
meters of the frame (no longitudes), with word, score, confidence, centroid, height_min_m and height_max_m,
area and volume. The collection's members `frame` and `T_frame_map` give the frame; `unit` says whether lengths are
meters. Source: RFC 7946.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.errors import ExportError
from ..core.transforms import transform
from ..query.regions import Region
from ..query.scan_map import Map
from ..settings.typed_options import TypedOptions
from .export_frames import UprightFrame, to_frame

REQUIRES: tuple[str, ...] = ()
ENDINGS = (".geojson", ".json")

_CORNERS = np.stack(np.unravel_index(np.arange(8), (2, 2, 2)), axis=1)


class Options(TypedOptions, frozen=True):
    """Words and frame."""

    words: tuple[str, ...] = ()
    """Words to ask, as in [sofa, chair]; none = all words that the map's encoder or a scene vocabulary names."""
    frame: UprightFrame = "gravity"
    """"gravity" (walls along x and y) or "start" (z up, first camera at the origin, its view along x)."""


def write(scan_map: Map, path: Path, options: Options) -> list[str]:
    """Writes the regions. Returns a sentence for each word that nothing matches (it has no feature in the file), or of
    which the encoder understands only a part. Raises ExportError for a map without words or without occupied voxels."""
    words = list(options.words) or scan_map.vocabulary
    if not words:
        raise ExportError("The map has no vocabulary: give words with --set 'words=[sofa, chair]'.")
    T_frame_map = to_frame(scan_map, options.frame)
    occupancy = scan_map.occupancy
    if not len(occupancy.colors):
        raise ExportError("The map has no occupied voxels, so words find nothing.")
    voxels, edges = occupancy.occupied_voxels(), occupancy.occupied_edges()

    def corners(rows: NDArray[np.int64]) -> NDArray[np.float64]:
        """Returns the (8 N, 3) corners of N voxels, in the frame."""
        lattice = voxels[rows, None] + _CORNERS * edges[rows, None, None]
        return transform(T_frame_map, occupancy.origin + lattice.reshape(-1, 3) * occupancy.finest)

    results = scan_map.query_words(words, top_k=len(occupancy.colors))
    features = [
        _feature(result.word, region, corners(region.rows), transform(T_frame_map, region.centroid))
        for result in results
        for region in result.regions
    ]
    collection = {
        "type": "FeatureCollection",
        "frame": options.frame,
        "T_frame_map": T_frame_map.tolist(),
        "unit": "metre" if scan_map.metric else "unknown",
        "features": features,
    }
    path.write_text(json.dumps(collection, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    return [result.note for result in results if result.note] if options.words else []


def _feature(word: str, region: Region, corners: NDArray[np.float64], centroid: NDArray[np.float64]) -> dict[str, Any]:
    ring, area = outline(corners[:, :2])
    return {
        "type": "Feature",
        "geometry": {"type": "Polygon", "coordinates": [ring.tolist()]},
        "properties": {
            "word": word,
            "score": round(region.score, 4),
            "confidence": round(region.confidence, 4),
            "centroid": np.round(centroid, 4).tolist(),
            "height_min_m": round(float(corners[:, 2].min()), 4),
            "height_max_m": round(float(corners[:, 2].max()), 4),
            "area_m2": round(area, 4),
            "volume_m3": round(region.volume_m3, 6),
        },
    }


def outline(points: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
    """Returns the convex hull of (N, 2) points that do not lie on a line, as a closed counter-clockwise ring of corners
    rounded to the millimeter, and its area."""
    from scipy.spatial import ConvexHull

    points = np.round(points[ConvexHull(points).vertices], 3)
    hull = ConvexHull(points)  # once more: corners of a turned lattice along an edge are not quite on one line
    return points[np.append(hull.vertices, hull.vertices[0])], float(hull.volume)
