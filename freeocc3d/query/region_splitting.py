"""Things that touch, told apart: a region is cut where it narrows, seen from above, to a voxel or two.

What stands on a floor stands beside other things, and voxels that are too coarse to show a gap join them by a neck. A
region's footprint has at each cell the distance to its rim, times how well the word fits there. Two maxima belong to
two things if every way from one to the other goes through a neck, lower than a share of the lower one. In a convex
footprint the distance to the rim is a concave function, so that it has one maximum, and no such thing is ever cut; nor
are legs and other thin ends, for they get nowhere wider than they are where they begin.

Source of the rule: persistence-based clustering, F. Chazal et al., Persistence-Based Clustering in Riemannian
Manifolds, J. ACM 2013; of distances as what is cut: S. Beucher, C. Lantuéjoul, Use of Watersheds in Contour Detection,
1979.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.types import Occupancy

_WIDE = 2.0
"""Cells that a thing reaches to either side of its middle at least, by which it is told from ragged rims."""
_NECK = 1.5
"""Cells that a neck reaches to either side at most: a door between two rooms is none."""
_STEP = 2**0.125
"""From one level to the next lower one: that much of a ratio may be missed."""
_SMALL_HOLE = 0.25
"""Of a footprint: what stands on a table hides a part of it; the inside of a room is none of its walls."""
_LEAST_VOXELS = 40  # two things that are wide enough
_LEAST_SCORE = 1e-3
_MOST_CELLS = 1 << 24  # of a footprint; a region that spreads farther stays whole
_TOUCHING = np.ones((3, 3), int)
_QUARTERS = np.stack(np.unravel_index(np.arange(8), (2, 2, 2)), axis=1) / 2 - 0.25


def told_apart(
    occupancy: Occupancy,
    rows: NDArray[np.int64],
    component: NDArray[np.int32],
    scores: NDArray[np.float32],
    up: NDArray[np.float64],
    narrow: float,
) -> NDArray[np.int32]:
    """(n,) numbers of parts of the components, of voxels given by (n,) rows.

    scores: (n,) of the word.  up: (3,) unit vector, map frame.  narrow: a neck's share of the width of the
    narrower of the things beside it, at most; 0 cuts nothing.
    """
    part = component.astype(np.int32)
    large = np.flatnonzero(np.bincount(component) >= _LEAST_VOXELS) if narrow > 0 and len(component) else ()
    number = int(component.max(initial=0)) + 1
    for c in large:
        own = np.flatnonzero(component == c)
        cell, footprint = _footprint(occupancy, rows[own], np.maximum(scores[own], _LEAST_SCORE), up)
        things = None if footprint is None else parts_of(footprint, narrow)
        if things is not None:
            part[own] = number + things[tuple(cell.T)]
            number += int(things.max()) + 1
    return part


def _footprint(
    occupancy: Occupancy, rows: NDArray[np.int64], scores: NDArray[np.float32], up: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.float32] | None]:
    """(n, 2) cell of each voxel seen from above, and (X, Y) best score in each cell, 0 outside, None for too many
    cells. A cell is as large as the largest of the voxels."""
    order = np.argsort(scores, kind="stable")  # of what falls into one cell the last is kept
    edges = occupancy.occupied_edges()[rows[order]]
    first = np.eye(3)[np.argmin(np.abs(up))]  # the axis of the lattice that is most nearly level
    first = first - (first @ up) * up
    first /= np.linalg.norm(first)
    level = np.stack((first, np.cross(up, first)), axis=1) / edges.max()
    middle = (occupancy.occupied_voxels()[rows[order]] + 0.5 * edges[:, None]) @ level
    middle += 0.5 - middle[0] + 1e-6  # a level lattice's centers come to lie in the cells' middles
    offsets = np.unique((_QUARTERS @ level).round(2), axis=0)  # half of them where the lattice is about level
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


def parts_of(footprint: NDArray[np.float32], narrow: float) -> NDArray[np.int32] | None:
    """(X, Y) number of the thing that each cell of a footprint belongs to, or the nearest; None for a single one.

    footprint: (X, Y) scores, positive in the region, 0 outside; holes that are small beside it count as filled.
    """
    height = _height(footprint)
    if height.max() < _WIDE:
        return None
    from scipy import ndimage

    # what a neck separates lies apart already where everything is higher than a neck
    basin = ndimage.label(height > _NECK, _TOUCHING)[0].ravel()
    above = np.flatnonzero(basin)
    above = above[np.argsort(height.flat[above], kind="stable")]
    top = np.zeros(basin.max() + 1, np.int64)
    top[basin[above]] = above  # of each basin the last is kept, which is its highest cell
    peaks = top[1:][height.flat[top[1:]] >= _WIDE]
    if len(peaks) < 2:
        return None
    owner = np.full(height.size, -1)  # the peak around which a cell lies, if none shares its basin
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
    """(X, Y) half of a width, in cells, times the score over the best."""
    from scipy import ndimage

    seen = footprint > 0
    hole, _ = ndimage.label(ndimage.binary_fill_holes(seen) & ~seen)
    small = np.bincount(hole.ravel()) <= _SMALL_HOLE * np.count_nonzero(seen)
    small[0] = False  # what is no hole
    solid = seen | small[hole]
    fits = np.where(seen, footprint / footprint.max(), 1.0)
    to_rim = ndimage.distance_transform_edt(np.pad(solid, 1))[1:-1, 1:-1]
    return np.asarray(np.where(solid, (to_rim - 0.5) * fits, 0.0))


def _persistent(
    peaks: NDArray[np.int64], basin: NDArray[np.int32], height: NDArray[np.float64], level: float, narrow: float
) -> NDArray[np.int64]:
    """The peaks that are still things of their own at a level: the highest of their basin, or high above it."""
    peaks = peaks[np.argsort(-height[peaks], kind="stable")]
    first = np.unique(basin[peaks], return_index=True)[1]
    kept = level <= np.minimum(narrow * height[peaks], _NECK)
    kept[first] = True
    return peaks[kept]
