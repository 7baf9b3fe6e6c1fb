"""Separates things that touch: cuts a region where it narrows, seen from above, to a voxel or two.

Coarse voxels close the gap between things that stand next to each other, and join them by a neck. Each cell of a
region's footprint has a height: the distance to the rim, times how well the word fits there. Two maxima belong to two
things if every path between them passes a neck that is lower than a share of the lower maximum. In a convex footprint
the distance to the rim is concave and has one maximum, so a convex thing is never cut. Legs and other thin ends are not
cut either, because nowhere are they wider than at their start.

Sources: the rule is persistence-based clustering, F. Chazal et al., Persistence-Based Clustering in Riemannian
Manifolds, J. ACM 2013; distances as heights: S. Beucher, C. Lantuéjoul, Use of Watersheds in Contour Detection, 1979.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.types import Occupancy

_WIDE = 2.0
"""Least number of cells from a thing's middle to its sides; ragged rims have less."""
_NECK = 1.5
"""Greatest number of cells from a neck's middle to its sides: a door between two rooms is not a neck."""
_STEP = 2**0.125
"""Ratio of one level to the next lower one: the error of a neck's height."""
_SMALL_HOLE = 0.25
"""Share of a footprint up to which holes are filled: things on a table hide a part of it, but the inside of a room does
not belong to its walls."""
_LEAST_VOXELS = 40  # enough for two things of the least width
_LEAST_SCORE = 1e-3
_MOST_CELLS = 1 << 24  # of a footprint; a larger region stays whole
_TOUCHING = np.ones((3, 3), int)
_QUARTERS = np.stack(np.unravel_index(np.arange(8), (2, 2, 2)), axis=1) / 2 - 0.25


def cut_necks(
    occupancy: Occupancy,
    rows: NDArray[np.int64],
    component: NDArray[np.int32],
    scores: NDArray[np.float32],
    up: NDArray[np.float64],
    narrow: float,
) -> NDArray[np.int32]:
    """Returns the (n,) part number of each voxel, after components are cut at their necks.

    rows: (n,) rows of occupied voxels.  component: (n,) their components.  scores: (n,) of the word.  up: (3,) unit
    vector, map frame.  narrow: greatest width of a neck, as a share of the narrower thing's width; 0 cuts nothing.
    """
    part = component.astype(np.int32)
    large = np.flatnonzero(np.bincount(component) >= _LEAST_VOXELS) if narrow > 0 and len(component) else ()
    number = int(component.max(initial=0)) + 1
    for c in large:
        own = np.flatnonzero(component == c)
        cell, footprint = _footprint(occupancy, rows[own], np.maximum(scores[own], _LEAST_SCORE), up)
        things = None if footprint is None else split_footprint(footprint, narrow)
        if things is not None:
            part[own] = number + things[tuple(cell.T)]
            number += int(things.max()) + 1
    return part


def _footprint(
    occupancy: Occupancy, rows: NDArray[np.int64], scores: NDArray[np.float32], up: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.float32] | None]:
    """Returns the (n, 2) cell of each voxel seen from above, and the (X, Y) best score in each cell: 0 outside, None
    for too many cells. A cell is as large as the largest voxel."""
    order = np.argsort(scores, kind="stable")  # in each cell the last score, the best, stays
    edges = occupancy.occupied_edges()[rows[order]]
    first = np.eye(3)[np.argmin(np.abs(up))]  # the most nearly level axis of the lattice
    first = first - (first @ up) * up
    first /= np.linalg.norm(first)
    level = np.stack((first, np.cross(up, first)), axis=1) / edges.max()
    middle = (occupancy.occupied_voxels()[rows[order]] + 0.5 * edges[:, None]) @ level
    middle += 0.5 - middle[0] + 1e-6  # puts a level lattice's centers in the middles of the cells
    offsets = np.unique((_QUARTERS @ level).round(2), axis=0)  # half as many for a nearly level lattice
    low = np.floor(middle.min(axis=0) - 1)
    shape = (np.floor(middle.max(axis=0) + 1) - low + 1).astype(np.int64)
    cells = np.empty((len(rows), 2), np.int64)
    cells[order] = np.floor(middle - low)
    if shape.prod() > _MOST_CELLS:
        return cells, None
    footprint = np.zeros(shape, np.float32)
    for offset in offsets:
        at = np.floor(middle + edges[:, None] * offset - low).astype(np.int64)
        here = footprint[at[:, 0], at[:, 1]]
        footprint[at[:, 0], at[:, 1]] = np.maximum(here, scores[order])
    return cells, footprint


def split_footprint(footprint: NDArray[np.float32], narrow: float) -> NDArray[np.int32] | None:
    """Returns the (X, Y) number of each cell's thing, or of the nearest thing; None if there is only one thing.

    footprint: (X, Y) scores, positive in the region, 0 outside; small holes count as filled.
    """
    height = _height(footprint)
    if height.max() < _WIDE:
        return None
    from scipy import ndimage

    # cells above the height of a neck already form separate basins on either side of each neck
    basin = ndimage.label(height > _NECK, _TOUCHING)[0].ravel()
    above = np.flatnonzero(basin)
    above = above[np.argsort(height.flat[above], kind="stable")]
    top = np.zeros(basin.max() + 1, np.int64)
    top[basin[above]] = above  # the last cell of each basin, its highest, stays
    peaks = top[1:][height.flat[top[1:]] >= _WIDE]
    if len(peaks) < 2:
        return None
    owner = np.full(height.size, -1)  # each cell's peak, if it is the only peak of its basin
    lowest = narrow * float(height.flat[peaks].min())
    levels = _NECK * _STEP ** -np.arange(max(np.ceil(np.log(_NECK / lowest) / np.log(_STEP)), 0))
    for level in (np.nextafter(_NECK, np.inf), *levels, min(lowest, _NECK)):
        basin = ndimage.label(height >= level, _TOUCHING)[0].ravel()
        peaks = _persistent(peaks, basin, height.ravel(), level, narrow)
        owner[~np.isin(owner, peaks)] = -1
        thing = np.full(basin.max() + 1, -1)
        thing[basin[peaks]] = np.where(np.bincount(basin[peaks])[basin[peaks]] == 1, peaks, -1)
        owner = np.where(owner < 0, thing[basin], owner)
    if len(peaks) < 2:
        return None
    number = np.searchsorted(np.sort(peaks), owner).reshape(height.shape)
    nearest: Any = ndimage.distance_transform_edt(
        owner.reshape(height.shape) < 0, return_distances=False, return_indices=True
    )
    return np.asarray(number[tuple(nearest)], np.int32)


def _height(footprint: NDArray[np.float32]) -> NDArray[np.float64]:
    """Returns the (X, Y) heights: distance to the rim in cells, times score / best score."""
    from scipy import ndimage

    seen = footprint > 0
    hole, _ = ndimage.label(ndimage.binary_fill_holes(seen) & ~seen)
    small = np.bincount(hole.ravel()) <= _SMALL_HOLE * np.count_nonzero(seen)
    small[0] = False  # label 0 is no hole
    solid = seen | small[hole]
    fits = np.where(seen, footprint / footprint.max(), 1.0)
    to_rim = ndimage.distance_transform_edt(np.pad(solid, 1))[1:-1, 1:-1]
    return np.asarray(np.where(solid, (to_rim - 0.5) * fits, 0.0))


def _persistent(
    peaks: NDArray[np.int64], basin: NDArray[np.int32], height: NDArray[np.float64], level: float, narrow: float
) -> NDArray[np.int64]:
    """Returns the peaks that stay separate things at a level: the highest of their basin, or high above the level."""
    peaks = peaks[np.argsort(-height[peaks], kind="stable")]
    first = np.unique(basin[peaks], return_index=True)[1]
    kept = level <= np.minimum(narrow * height[peaks], _NECK)
    kept[first] = True
    return peaks[kept]
