"""Regions: connected matching voxels, with their scores and places. The module imports little, to start fast."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..core.types import Occupancy

_PATCH, _FEW = 4, 50
"""Voxels of the smallest patch of a surface, two by two; a smaller region needs a share this much larger."""
_BESIDE_M = 0.5
_MOST_COMPARED = 4_000_000
_DOUBT_M3 = 0.001
"""Non-matching volume that the score adds to each region. So a speck of a voxel or two does not outrank a large object,
whatever the voxel size."""


@dataclass(frozen=True)
class Region:
    """A connected set of matching voxels, or one of the things in it.

    score: 0…1, ranks the regions and says how well the word fits. It is the mean score of the voxels times V / (V + 1
    liter) for a volume V, as if the region had one more liter that does not match. A voxel's score is its cosine with
    the word over the cosine of a perfect example. So 1 is a large thing with perfect voxels only. Scores compare within
    one encoder.
    confidence: 0…1, how probable the word is against the other things that the voxels could be. It is the mean, by
    volume, of the voxels' softmax probabilities against the contrast words, at the encoder's temperature. A picture has
    no contrast words: its confidence is the mean score. A region may fit badly (low score) and still be nothing else
    (high confidence).
    centroid: (3,) mean of the voxels' centers, map frame, meters.
    box_min, box_max: (3,) corners of the axis-aligned box around the voxels, faces included, meters.  rows: (n,) rows
    of ``Occupancy.occupied_voxels()``.  label: the word that found it.
    number, name: of the object that it is, if whole objects were asked for; see ``query.objects.ranking``.
    """

    score: float
    confidence: float
    centroid: NDArray[np.float64]
    box_min: NDArray[np.float64]
    box_max: NDArray[np.float64]
    volume_m3: float
    rows: NDArray[np.int64]
    label: str = ""
    number: int | None = None
    name: str = ""

    @property
    def voxels(self) -> int:
        """Number of voxels."""
        return len(self.rows)


def best_regions(
    occupancy: Occupancy,
    rows: NDArray[np.int64],
    component: NDArray[np.integer],
    scores: NDArray[np.float32],
    confidence: NDArray[np.float32],
    min_voxels: int,
    min_share: float,
    top_k: int,
    label: str = "",
) -> list[Region]:
    """Returns up to ``top_k`` regions of the matching voxels, best first.

    rows: (n,) rows of occupied voxels.  component: (n,) region numbers, which may have gaps.  scores, confidence: (n,).
    The result leaves out regions of fewer than ``min_voxels`` voxels, unless all are so small. It leaves out regions of
    less than ``min_share`` of the largest region's volume. Of regions smaller than a patch of a surface, it leaves out
    those of less than 50 times this share of the volume of a region nearby.
    """
    if len(rows) == 0:
        return []
    edges = occupancy.occupied_edges()[rows]
    own_volume = (edges * occupancy.finest) ** 3
    size, volume = np.bincount(component), np.bincount(component, own_volume)
    score = np.bincount(component, scores * own_volume) / (volume + _DOUBT_M3)
    there = (size > 0) & (volume >= min_share * volume.max())
    if min_share:
        there[_specks(occupancy, rows, component, size, volume, _FEW * min_share)] = False
    large = there & (size >= min_voxels)
    chosen = np.flatnonzero(large if large.any() else there)
    chosen = chosen[np.argsort(-score[chosen], kind="stable")][:top_k]

    rank = np.full(len(size), len(chosen))
    rank[chosen] = np.arange(len(chosen))
    order = np.argsort(rank[component], kind="stable")[: size[chosen].sum()]
    starts = np.cumsum(size[chosen]) - size[chosen]
    own, weights = rows[order], np.asarray(own_volume[order, None])
    corners, upper = occupancy.occupied_voxels()[own], occupancy.occupied_voxels()[own] + edges[order, None]
    low = occupancy.origin + np.minimum.reduceat(corners, starts) * occupancy.finest
    high = occupancy.origin + np.maximum.reduceat(upper, starts) * occupancy.finest
    said = np.concatenate((occupancy.centers(corners, edges[order]), confidence[order, None]), axis=1)
    means = np.add.reduceat(said * weights, starts) / volume[chosen, None]
    return [
        Region(
            score=float(score[c]),
            confidence=float(means[n, 3]),
            centroid=means[n, :3],
            box_min=low[n],
            box_max=high[n],
            volume_m3=float(volume[c]),
            rows=own[starts[n] : starts[n] + size[c]],
            label=label,
        )
        for n, c in enumerate(chosen)
    ]


def _specks(
    occupancy: Occupancy,
    rows: NDArray[np.int64],
    component: NDArray[np.integer],
    size: NDArray[np.integer],
    volume: NDArray[np.number],
    share: float,
) -> NDArray[np.int64]:
    """Returns the regions of a few voxels that have less than ``share`` of the volume of a region within half a meter,
    from box to box: a chair's feet are no chairs, and a cup in the middle of a room is no part of the carpet."""
    few, things = np.flatnonzero((size > 0) & (size < _PATCH)), np.flatnonzero(size >= _PATCH)
    if not len(few) or not len(things):
        return few[:0]
    things = things[np.argsort(-volume[things], kind="stable")][: max(1, _MOST_COMPARED // len(few))]
    order = np.argsort(component, kind="stable")
    starts = (np.cumsum(size) - size)[size > 0]
    place = np.cumsum(size > 0) - 1
    corners = occupancy.occupied_voxels()[rows[order]]
    upper = corners + occupancy.occupied_edges()[rows[order], None]
    low, high = np.minimum.reduceat(corners, starts), np.maximum.reduceat(upper, starts)
    gaps = np.zeros((len(few), len(things)))
    for axis in range(3):
        below = low[place[things], axis][None] - high[place[few], axis][:, None]
        above = low[place[few], axis][:, None] - high[place[things], axis][None]
        gaps += np.maximum(np.maximum(below, above), 0) ** 2
    near = gaps <= (_BESIDE_M / occupancy.finest) ** 2
    return few[(near & (volume[few][:, None] < share * volume[things][None])).any(axis=1)]
