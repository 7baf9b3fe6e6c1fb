"""Writes a map as one HTML file with the viewer in it, which needs no server and no network."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ...core.transforms import invert, project, transform
from ...query.scan_map import Map
from ..self_contained_pages import write_page
from .answers import Asked, describe_views, find_answers
from .packets import compress, pack
from .page import whole_page
from .scene_arrays import describe_scene, describe_space

MOST_GAUSSIANS = 100_000
"""Gaussians of a page: the largest, by area and opacity."""

MOST_WORDS = 40
"""Words of a page if none are asked for: the classes with most voxels."""

_PHOTOGRAPH_WIDTH, _QUALITY = 480, 70
_PHOTOGRAPH_BYTES = 5_000_000
"""All photographs of a page together; further keyframes are drawn without one."""


def write_whole_page(scan_map: Map, path: Path, words: Sequence[str] = (), overwrite: bool = False) -> None:
    """Writes the page. The same map gives the same page.

    words: whose answers the page holds; by default those of the map's classes that have most voxels. Raises
    ExportError: the file exists or cannot be written; MapError for a damaged map; FreeOccError for words that
    cannot be asked.
    """
    write_page(path, make_whole_page(scan_map, words), overwrite)


def make_whole_page(scan_map: Map, words: Sequence[str] = ()) -> str:
    """Returns the page that ``write_whole_page`` writes."""
    meta, arrays = describe_scene(scan_map, MOST_GAUSSIANS)
    asked = list(words) or [each["name"] for each in meta["classes"] if each["number"]][:MOST_WORDS]
    answers, rows = _answers(scan_map, asked)
    photographs, ends = _photographs(scan_map)
    arrays |= describe_space(scan_map)[1]
    arrays |= {
        "answer_rows": rows,
        "photographs": photographs,
        "photograph_ends": ends,
        "best_keyframe": _best_keyframes(scan_map),
    }
    packet = compress(pack({**meta, "version": "held", "words": answers}, arrays), level=9)
    facts = {"ask": ", ".join(words)}
    return whole_page(base64.b64encode(packet).decode(), facts, f"{meta['title']} – freeocc3d")


def _answers(scan_map: Map, words: Sequence[str]) -> tuple[list[dict[str, Any]], NDArray[np.uint32]]:
    """Returns the answers to words with their places in the rows, and the rows of all regions."""
    if not words:
        return [], np.zeros(0, np.uint32)
    found = find_answers(scan_map, Asked(words=list(words)))
    views = iter(scan_map.views_of_each(found.regions))
    regions, at = iter(found.regions), 0
    for result in found.described:
        result["from"] = at
        for described in result["regions"]:
            at += len(next(regions).rows)
            described["views"] = describe_views(scan_map, next(views))
        result["to"] = at
    rows = [region.rows for region in found.regions]
    return found.described, np.concatenate(rows).astype(np.uint32) if rows else np.zeros(0, np.uint32)


def _photographs(scan_map: Map) -> tuple[NDArray[np.uint8], NDArray[np.uint32]]:
    """Returns the JPEGs of the keyframes, one after the other, and the (K,) ends. If they are too many, every second,
    third, … keyframe has one."""
    keyframes = scan_map.keyframes
    every, images = 1, [b""] * len(keyframes)
    while every <= max(len(keyframes), 1):
        images, total = [b""] * len(keyframes), 0
        for row in range(0, len(keyframes), every):
            images[row] = _shrunk(keyframes[row].color)
            total += len(images[row])
            if total > _PHOTOGRAPH_BYTES:
                break
        else:
            break
        every += 1
    data = np.frombuffer(b"".join(images), np.uint8)
    return data, np.cumsum([len(image) for image in images]).astype(np.uint32)


def _shrunk(color: NDArray[np.uint8]) -> bytes:
    height, width = color.shape[:2]
    scale = min(1.0, _PHOTOGRAPH_WIDTH / width)
    size = max(1, round(scale * width)), max(1, round(scale * height))
    small = cv2.resize(color, size, interpolation=cv2.INTER_AREA)
    return bytes(cv2.imencode(".jpg", small[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1])


def _best_keyframes(scan_map: Map) -> NDArray[np.uint16]:
    """Returns the (V,) row of the keyframe that shows each occupied voxel from nearest; 65535 = none."""
    occupancy, trajectory = scan_map.occupancy, scan_map.trajectory
    voxels, edges = occupancy.occupied_voxels(), occupancy.occupied_edges()
    centers, sizes = occupancy.centers(voxels, edges), edges * occupancy.finest
    best, nearest = np.full(len(centers), 65535, np.uint16), np.full(len(centers), np.inf)
    for row, (_, camera) in enumerate(scan_map.keyframes.views()[:65535]):
        pixels, z = project(transform(invert(trajectory.T_world_keyframe[row]), centers), camera)
        with np.errstate(invalid="ignore"):
            at = np.rint(pixels)
            inside = np.flatnonzero(((at >= 0) & (at < (camera.width, camera.height))).all(axis=1) & (z < nearest))
        u, v = at[inside].astype(np.int64).T
        measured = scan_map.keyframes.depth_m(row)[v, u]
        shown = inside[(measured > 0) & (np.abs(measured - z[inside]) <= sizes[inside])]
        best[shown], nearest[shown] = row, z[shown]
    return best
