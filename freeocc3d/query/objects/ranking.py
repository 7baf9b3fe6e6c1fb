"""Answers with whole objects: a word finds a chair once, not as several specks of it, and not together with the floor
of the same color.

A voxel's feature is uncertain; an object's, a mean over many voxels or views, is much less so. So a question is asked
twice: of the voxels, and of a copy of the map in which the voxels of an object have the object's feature. An object is
an answer if its feature matches, or if at least half of it matches by its voxels' own. Then follows what else matches,
such as the floor. Sources of the ideas: Q. Gu et al., ConceptGraphs, ICRA 2024 (features of objects); A. Takmaz et al.,
OpenMask3D, NeurIPS 2023 (instances that gather what their points say).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ...core.types import Occupancy
from ...language.feature_codec import CodedFeatures
from ..regions import Region, best_regions
from ..word_query import QueryResult
from .object import Object

_MATCHING = 0.5
"""Least share of an object's volume that matches."""
_LEFT = 0.5
"""Least share of a region that must remain beside the objects in it. Less is their fringe."""
_PATCH = 8  # voxels: a patch of surface of two by two voxels, two deep; less beside objects is a speck


def pool_features(occupancy: Occupancy, objects: Sequence[Object]) -> Occupancy:
    """Returns the voxels with the feature of their object in place of their own, if the object has one."""
    known = [thing for thing in objects if thing.feature.any()]
    if not known:
        return occupancy
    rows = np.concatenate([thing.rows for thing in known])
    own = np.repeat(np.arange(len(known)), [len(thing.rows) for thing in known])
    features, pooled = occupancy.features, np.stack([thing.feature for thing in known])
    if isinstance(features, CodedFeatures):
        codes = features.codes.copy()
        codes[rows] = features.codec.encode(pooled)[own]
        return occupancy.replace(features=CodedFeatures(features.codec, codes))
    dense = np.array(features)
    dense[rows] = pooled.astype(dense.dtype)[own]
    return occupancy.replace(features=dense)


def rank_objects(
    occupancy: Occupancy, plain: QueryResult, pooled: QueryResult, objects: Sequence[Object]
) -> QueryResult:
    """Returns an answer with the objects that match as its first regions, best score first, and then the regions that
    are left.

    plain, pooled: the answers of the map and of that of ``pool_features``, with all their regions.  A region that is an
    object has the object's number, from 1, and name. Its score and confidence are those of its voxels in the answer
    that it comes of. If no object matches, the plain answer stays.
    """
    instance = np.full(len(plain.scores), -1)
    for number, thing in enumerate(objects):
        instance[thing.rows] = number
    volume = np.asarray((occupancy.occupied_edges() * occupancy.finest) ** 3, np.float64)
    things: list[Region] = []
    for result in (pooled, plain):
        known = np.array([thing.number for thing in things if thing.number is not None], np.int64) - 1
        share, confidence = _count_matches(result, instance, volume, len(objects))
        share[known] = 0
        held = np.flatnonzero(instance >= 0)
        rows = held[share[instance[held]] >= _MATCHING]
        things += [
            replace(region, confidence=float(confidence[k]), number=k + 1, name=objects[k].name)
            for region in _regions(occupancy, rows, instance[rows], result)
            for k in [int(instance[region.rows[0]])]
        ]
    if not things:
        return plain
    things.sort(key=lambda region: -region.score)
    taken = np.zeros(len(instance), bool)
    taken[np.concatenate([region.rows for region in things])] = True
    rest = [
        _remaining(occupancy, region, region.rows[~taken[region.rows]], volume, pooled) for region in pooled.regions
    ]
    answer = pooled if pooled.matched else plain
    return replace(answer, regions=[*things, *(region for region in rest if region is not None)])


def _count_matches(
    result: QueryResult, instance: NDArray[np.integer], volume: NDArray[np.float64], count: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns the (N,) share of each object's volume that matches, and the (N,) mean confidence there."""
    confidence, matched = np.zeros(len(instance)), np.zeros(len(instance), bool)
    for region in result.regions:
        confidence[region.rows], matched[region.rows] = region.confidence, True
    held = instance >= 0
    matched &= held
    whole = np.bincount(instance[held], volume[held], count)
    part = np.bincount(instance[matched], volume[matched], count)
    sure = np.bincount(instance[matched], (volume * confidence)[matched], count)
    return part / np.maximum(whole, 1e-12), sure / np.maximum(part, 1e-12)


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
