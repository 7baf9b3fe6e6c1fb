"""Answers with whole objects: a word that matches most of a chair finds the chair once, not as several specks of it,
and not together with the floor of the same color.

A voxel's match is uncertain, and an object's is the vote of its voxels. So an object of which at least half matches is
an answer, with all its voxels. What matches besides, on surfaces that are no objects or on parts of objects, follows.
Source of the idea: instances that gather votes of their points, A. Takmaz et al., OpenMask3D, NeurIPS 2023.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ...core.types import Occupancy
from ..regions import Region, best_regions
from ..word_query import QueryResult
from .object import Object

_MATCHING = 0.5
"""Least share of an object's volume that matches."""
_LEFT = 0.5
"""Least share of a region that must remain beside the objects in it. Less is their fringe."""
_PATCH = 8  # voxels: a patch of surface of two by two voxels, two deep; less beside objects is a speck


def rank_objects(occupancy: Occupancy, result: QueryResult, objects: Sequence[Object]) -> QueryResult:
    """Returns an answer with the objects that match as its first regions, best score first, and then the regions that
    are left.

    result: the answer with all its regions.  A region that is an object has the object's number, from 1, and name. Its
    score is that of a region of all its voxels; its confidence is the mean of the regions that it comes of, by volume.
    """
    count = len(result.scores)
    confidence, region_of = np.zeros(count, np.float32), np.full(count, -1)
    for number, region in enumerate(result.regions):
        confidence[region.rows], region_of[region.rows] = region.confidence, number
    instance = np.full(count, -1)
    for number, thing in enumerate(objects):
        instance[thing.rows] = number
    volume = np.asarray((occupancy.occupied_edges() * occupancy.finest) ** 3, np.float64)
    held, matched = instance >= 0, (instance >= 0) & (region_of >= 0)
    whole = np.bincount(instance[held], volume[held], len(objects))
    part = np.bincount(instance[matched], volume[matched], len(objects))
    answers = part >= np.maximum(_MATCHING * whole, 1e-12)
    if not answers.any():
        return result
    sure = np.bincount(instance[matched], (volume * confidence)[matched], len(objects)) / np.maximum(part, 1e-12)
    rows = np.flatnonzero(held & answers[instance])
    found = _regions(occupancy, rows, instance[rows], result)
    of = [int(instance[region.rows[0]]) for region in found]
    things = [
        replace(region, confidence=float(sure[k]), number=k + 1, name=objects[k].name)
        for region, k in zip(found, of, strict=True)
    ]
    taken = np.zeros(count, bool)
    taken[rows] = True
    rest = [
        _remaining(occupancy, region, region.rows[~taken[region.rows]], volume, result) for region in result.regions
    ]
    return replace(result, regions=[*things, *(region for region in rest if region is not None)])


def _regions(
    occupancy: Occupancy, rows: NDArray[np.int64], component: NDArray[np.integer], result: QueryResult
) -> list[Region]:
    scores = np.maximum(result.scores[rows], 0)
    numbers = np.asarray(component, np.int32)
    return best_regions(occupancy, rows, numbers, scores, scores, 1, 0.0, max(len(rows), 1), result.word)


def _remaining(
    occupancy: Occupancy, region: Region, rows: NDArray[np.int64], volume: NDArray[np.float64], result: QueryResult
) -> Region | None:
    """Returns what is left of a region, or None for a fringe or a speck."""
    if len(rows) < _PATCH or volume[rows].sum() < _LEFT * region.volume_m3:
        return None
    if len(rows) == len(region.rows):
        return region
    (left,) = _regions(occupancy, rows, np.zeros(len(rows), np.int32), result)
    return replace(left, confidence=region.confidence)
