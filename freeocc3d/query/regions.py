"""Regions: matching voxels that hang together, with what is said of them. Imports little, to start fast."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..core.types import Occupancy

_PATCH, _FEW = 4, 50
"""Voxels of the least patch of a surface, two by two; of how much larger a share what is smaller has to be."""
_BESIDE_M = 0.5
_MOST_COMPARED = 4_000_000
_DOUBT_M3 = 0.001
"""Volume of non-matching matter that is added to each region when it is scored: a speck of a voxel or two does not
outrank a large object, and the size of the voxels has no part in it."""


@dataclass(frozen=True)
class Region:
    """A connected set of matching voxels, or one of the things that it holds.

    score: 0…1, by which regions are ranked: the mean score of its voxels times V / (V + 1 liter), V being its volume,
    as if a liter that does not match belonged to it. A voxel's is its cosine with the word over the one that a perfect
    example reaches, so that 1 is a large thing all of whose voxels say the word and no other. It says how well the word
    fits, and compares within an encoder.
    confidence: 0…1, how probable the word is beside what else the voxels could be: the mean, by volume, of their
    softmax probabilities of the word against the contrast words, at the encoder's temperature (for a picture, which has
    no contrast words, the mean score). A region may fit badly (low score) and still be nothing else (high confidence).
    centroid: (3,) mean of the voxels' centers, map frame, meters.
    box_min, box_max: (3,) corners of the axis-aligned box around the voxels, faces included, meters.  rows: (n,) rows
    of ``Occupancy.occupied_voxels()``.  label: the word that it was found by.
    """

    score: float
    confidence: float
    centroid: NDArray[np.float64]
    box_min: NDArray[np.float64]
    box_max: NDArray[np.float64]
    volume_m3: float
    rows: NDArray[np.int64]
    label: str = ""

    @property
    def voxels(self) -> int:
        """Number of voxels."""
        return len(self.rows)


def best_regions(
    occupancy: Occupancy,
    rows: NDArray[np.int64],
    component: NDArray[np.int32],
    scores: NDArray[np.float32],
    confidence: NDArray[np.float32],
    min_voxels: int,
    min_share: float,
    top_k: int,
    label: str = "",
) -> list[Region]:
    """The at most ``top_k`` best regions, best first, among matching voxels.

    rows: (n,) rows of occupied voxels, component: (n,) the region of each, of numbers that need not be successive,
    scores, confidence: (n,). Regions of fewer than ``min_voxels`` voxels are left out, unless all are, those of less
    than ``min_share`` of the largest one's volume, and, of what is no patch of a surface, those of less than 50 times
    this share of the volume of a region nearby.
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
    """Regions of a few voxels whose box lies within half a meter of that of a region which they are less than ``share``
    of: a chair's feet are no chairs, and a cup in the middle of a room is no part of the carpet."""
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
