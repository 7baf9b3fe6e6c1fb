"""What the page asks of a map, and the packets that answer it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from ...core.errors import FreeOccError
from ...core.transforms import invert, project, transform
from ...query.best_views import RegionView
from ...query.conditions import Where
from ...query.questions import Question, ask
from ...query.regions import Region
from ...query.scan_map import Map
from ...query.word_query import QueryResult
from ..distinct_colors import distinct_colors
from .packets import pack

MOST_WORDS, MOST_REGIONS = 20, 200
_NEAREST, _VIEWS, _NAMES = 24, 3, 5

_Word = Annotated[str, msgspec.Meta(min_length=1, max_length=200)]
_Meters = Annotated[float, msgspec.Meta(ge=-1e6, le=1e6)]
_Corners = tuple[_Meters, _Meters, _Meters, _Meters, _Meters, _Meters]


class Asked(msgspec.Struct, forbid_unknown_fields=True):
    """A question as the page sends it. within: a box x0 y0 z0 x1 y1 z1, map frame, meters."""

    words: Annotated[list[_Word], msgspec.Meta(max_length=MOST_WORDS)] = []
    classes: Annotated[list[_Word], msgspec.Meta(max_length=MOST_WORDS)] = []
    negative: Annotated[list[_Word], msgspec.Meta(max_length=MOST_WORDS)] = []
    near: _Word | None = None
    near_m: Annotated[float, msgspec.Meta(ge=0, le=1e6)] = Where.near_m
    on: _Word | None = None
    within: _Corners | None = None


@dataclass(frozen=True)
class Found:
    """The answers to a question. described: one document an answer.  regions: of all answers, in order."""

    described: list[dict[str, Any]]
    regions: list[Region]
    results: list[QueryResult]

    def packet(self, facts: Mapping[str, Any]) -> bytes:
        """The packet that shows them. facts: more keys of the document beside ``results``.

        Arrays: ``rows`` uint32, those of all regions, in order; ``scores`` uint8 / 255 of every voxel, for each answer.
        """
        rows = [region.rows.astype(np.uint32) for region in self.regions]
        scores = [np.rint(255 * np.clip(result.scores, 0, 1)).astype(np.uint8) for result in self.results]
        arrays = {
            "rows": np.concatenate([np.zeros(0, np.uint32), *rows]),
            "scores": np.concatenate([np.zeros(0, np.uint8), *scores]),
        }
        return pack({"results": self.described, **facts}, arrays)


def find_answers(scan_map: Map, asked: Asked) -> Found:
    """Returns the answers, each with the keys of ``query --json``, ``color`` and, for a region, its upright box
    (``T_map_box``, ``extent``). Raises FreeOccError as ``query.questions.ask`` does."""
    conditions = Where(within=asked.within, near=asked.near, near_m=asked.near_m, on=asked.on)
    where = None if conditions == Where() else conditions
    question = Question(asked.words, asked.negative, asked.classes, where=where, options={"top_k": MOST_REGIONS})
    results = ask(scan_map, question)
    return Found(_describe(scan_map, results), [region for result in results for region in result.regions], results)


def _describe(scan_map: Map, results: Sequence[QueryResult]) -> list[dict[str, Any]]:
    boxes = iter(scan_map.boxes_of([region for result in results for region in result.regions]))
    colors = distinct_colors(len(results))
    return [
        {
            "word": result.word,
            "understood": result.understood,
            "note": result.note,
            "color": colors[number].tolist(),
            "regions": [
                {
                    "name": region.name or region.label,
                    "object": region.number,
                    "score": round(region.score, 4),
                    "confidence": round(region.confidence, 4),
                    "centroid": region.centroid.tolist(),
                    "box_min": region.box_min.tolist(),
                    "box_max": region.box_max.tolist(),
                    "volume_m3": region.volume_m3,
                    "voxels": region.voxels,
                    "T_map_box": (box := next(boxes)).T_map_box.tolist(),
                    "extent": box.extent.tolist(),
                }
                for region in result.regions
            ],
        }
        for number, result in enumerate(results)
    ]


def describe_views(scan_map: Map, views: Sequence[RegionView]) -> list[dict[str, Any]]:
    """Returns plain values: the row of each keyframe, its frame in the capture, and the box in pixels."""
    rows = {int(frame): row for row, frame in enumerate(scan_map.trajectory.keyframes)}
    return [
        {"keyframe": rows[view.frame], "frame": view.frame, "box": list(view.box), "visible": round(view.visible, 3)}
        for view in views
    ]


def describe_voxel(scan_map: Map, row: int) -> dict[str, Any]:
    """Returns what is known of an occupied voxel: its center, its words that fit best with their cosines, and the
    keyframes that show it best. Raises FreeOccError for a row that the map does not have."""
    occupancy = scan_map.occupancy
    if not 0 <= row < len(occupancy.colors):
        raise FreeOccError(f"The map {scan_map.path} has no voxel {row}: load the page again.")
    corner, edge = occupancy.occupied_voxels()[row : row + 1], occupancy.occupied_edges()[row : row + 1]
    center, size = occupancy.centers(corner, edge)[0], float(occupancy.finest * edge[0])
    return {
        "row": row,
        "center": center.tolist(),
        "size": size,
        "words": _best_words(scan_map, row),
        "views": _views_of_point(scan_map, center, size),
    }


def _best_words(scan_map: Map, row: int) -> list[dict[str, Any]]:
    """Returns the names of the vocabulary that fit a voxel best; none if nothing is known there, or if the map cannot
    be asked."""
    from ...language.feature_codec import compute_cosines

    feature = np.asarray(scan_map.occupancy.features[row : row + 1])
    try:
        names = scan_map.vocabulary[:253]
        if not names or not feature.any():
            return []
        cosines = compute_cosines(feature, scan_map.text_encoder.encode_words(names).features)[0]
    except FreeOccError:
        return []
    best = np.argsort(-cosines, kind="stable")[:_NAMES].tolist()
    return [{"word": names[k], "cosine": round(float(cosines[k]), 3)} for k in best if cosines[k] > 0]


def _views_of_point(scan_map: Map, point: NDArray[np.float64], size: float) -> list[dict[str, Any]]:
    """Returns up to three keyframes whose depth shows a voxel, of the nearest ones, nearest first."""
    found: list[tuple[float, int, list[int]]] = []
    trajectory = scan_map.trajectory
    for row, (_, camera) in enumerate(scan_map.keyframes.views()):
        pixels, z = project(transform(invert(trajectory.T_world_keyframe[row]), point[None]), camera)
        if z[0] > 0 and 0 <= pixels[0, 0] <= camera.width - 1 and 0 <= pixels[0, 1] <= camera.height - 1:
            found.append((float(z[0]), row, np.rint(pixels[0]).astype(int).tolist()))
    shown = []
    for z_m, row, (u, v) in sorted(found)[:_NEAREST]:
        measured = float(scan_map.keyframes.depth_m(row)[v, u])
        if measured > 0 and abs(measured - z_m) <= size:
            shown.append({"keyframe": row, "frame": int(trajectory.keyframes[row]), "pixel": [u, v]})
            if len(shown) == _VIEWS:
                break
    return shown
