"""The answers to a query, as text and as the document of ``query --json``."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .. import __version__
from ..query.regions import Region
from ..query.word_query import QueryResult


@dataclass(frozen=True)
class AnswerFrame:
    """The frame of the printed places. name: of the frame.  T_frame_map: (4, 4).  move: gives a region in it."""

    name: str
    T_frame_map: NDArray[np.float64]
    move: Callable[[Region], Region]


def answers_document(
    map_path: Path,
    results: Sequence[QueryResult],
    more: Callable[[Region], dict[str, Any]] | None = None,
    metric: bool = True,
    frame: AnswerFrame | None = None,
) -> dict[str, Any]:
    """Plain values: meters (if ``metric``) in the frame, by default the map's, fractions 0 to 1. more: returns further
    keys of a region."""
    move = (lambda region: region) if frame is None else frame.move
    return {
        "version": __version__,
        "map": str(map_path),
        "metric": metric,
        "frame": "map" if frame is None else frame.name,
        "T_frame_map": np.eye(4).tolist() if frame is None else frame.T_frame_map.tolist(),
        "results": [
            {
                "word": result.word,
                "matched": result.matched,
                "understood": result.understood,
                "note": result.note,
                "regions": [_region(move(region)) | (more(region) if more else {}) for region in result.regions],
            }
            for result in results
        ],
    }


def _region(region: Region) -> dict[str, Any]:
    return {
        "label": region.label,
        "object": region.number,
        "name": region.name,
        "score": round(region.score, 4),
        "confidence": round(region.confidence, 4),
        "centroid": region.centroid.round(4).tolist(),
        "box_min": region.box_min.round(4).tolist(),
        "box_max": region.box_max.round(4).tolist(),
        "volume_m3": round(region.volume_m3, 6),
        "voxels": region.voxels,
    }


def answers_lines(results: Sequence[QueryResult], metric: bool = True, frame: AnswerFrame | None = None) -> list[str]:
    """A table for people, in meters and liters, or in the map's units if not ``metric``, in the map's frame by
    default."""
    move = (lambda region: region) if frame is None else frame.move
    length, volume, per_unit3, digits = ("m", "l", 1000, 1) if metric else ("units", "units^3", 1, 5)
    lines = []
    for result in results:
        count = len(result.regions)
        things = sum(region.number is not None for region in result.regions)
        counted = [_count(things, "object")] * bool(things) + [_count(count - things, "region")] * (count > things)
        title = f"{result.word}: {', '.join(counted) or 'no match'}"
        lines.append(f"{title}. {result.note}".rstrip(". ") + ("." if result.note else ""))
        if count:
            columns = f"{f'centroid ({length})':23}  {f'size ({length})':19}  {f'volume ({volume})':>10}"
            lines.append(f"   #  score  conf.  {columns}  voxels" + "  object" * bool(things))
        for number, region in enumerate(map(move, result.regions), start=1):
            x, y, z = region.centroid
            dx, dy, dz = region.box_max - region.box_min
            lines.append(
                f"  {number:2d}   {region.score:.2f}   {region.confidence:.2f}  "
                f"{x:7.2f} {y:7.2f} {z:7.2f}  {dx:5.2f} x {dy:4.2f} x {dz:4.2f}  "
                f"{per_unit3 * region.volume_m3:{len(f'volume ({volume})')}.{digits}f}  {region.voxels:6d}"
                + (f"  {region.number} {region.name}" if region.number is not None else "")
            )
    return lines


def _count(number: int, what: str) -> str:
    return f"{number} {what}{'' if number == 1 else 's'}"
