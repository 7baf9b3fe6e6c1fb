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

from .types import Occupancy

_WIDE = 2.0
"""Cells that a thing reaches to either side of its middle at least, by which it is told from ragged rims."""
_NECK = 1.5
"""Cells that a neck reaches to either side at most: a door between two rooms is none."""
_STEP = 2**0.25
"""From one level to the next lower one: that much of a ratio may be missed."""
_SMALL_HOLE = 0.25
"""Of a footprint: what stands on a table hides a part of it; the inside of a room is none of its walls."""
_LEAST_VOXELS = 40  # two things that are wide enough
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

    scores: (n,) of the word, positive.  up: (3,) unit vector, map frame.  narrow: a neck's share of the width of the
    narrower of the things beside it, at most; 0 cuts nothing.
    """
    part = component.astype(np.int32)
    large = np.flatnonzero(np.bincount(component) >= _LEAST_VOXELS) if narrow > 0 and len(component) else ()
    number = int(component.max(initial=0)) + 1
    for c in large:
        own = np.flatnonzero(component == c)
        cell, footprint = _footprint(occupancy, rows[own], scores[own], up)
        things = parts_of(footprint, narrow)
        if things is not None:
            part[own] = number + things[tuple(cell.T)]
            number += int(things.max()) + 1
    return part


def _footprint(
    occupancy: Occupancy, rows: NDArray[np.int64], scores: NDArray[np.float32], up: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """(n, 2) cell of each voxel seen from above, and (X, Y) best score in each cell, 0 outside. A cell is as large as
    the largest of the voxels."""
    edges = occupancy.occupied_edges()[rows]
    centers = occupancy.centers(occupancy.occupied_voxels()[rows], edges)
    cell_m = float(edges.max() * occupancy.finest)
    first = np.eye(3)[np.argmin(np.abs(up))]  # the axis of the lattice that is most nearly level
    first = first - (first @ up) * up
    first /= np.linalg.norm(first)
    level = np.stack((first, np.cross(up, first)), axis=1)
    spread = (centers[:, None] + _QUARTERS * (edges * occupancy.finest)[:, None, None]) @ level
    # a level lattice's centres come to lie in the cells' middles
    origin = centers[0] @ level - 0.5 * cell_m
    cells = np.floor((spread - origin) / cell_m + 1e-6).astype(np.int64)
    corner = cells.reshape(-1, 2).min(axis=0)
    footprint = np.zeros(cells.reshape(-1, 2).max(axis=0) - corner + 1, np.float32)
    at = cells - corner
    np.maximum.at(footprint, (at[..., 0].ravel(), at[..., 1].ravel()), np.repeat(scores, 8))
    middle = np.floor((centers @ level - origin) / cell_m + 1e-6).astype(np.int64) - corner
    return middle, footprint


def parts_of(footprint: NDArray[np.float32], narrow: float) -> NDArray[np.int32] | None:
    """(X, Y) number of the thing that each cell of a footprint belongs to, or the nearest; None for a single one.

    footprint: (X, Y) scores, positive in the region, 0 outside; holes that are small beside it count as filled.
    """
    height = _height(footprint)
    highest = float(height.max())
    if highest < _WIDE:
        return None
    from scipy import ndimage

    lowest = min(narrow * highest, _NECK)
    levels = highest * _STEP ** -np.arange(np.ceil(np.log(highest / lowest) / np.log(_STEP)) + 1)
    peaks: list[tuple[int, ...]] = []  # a thing's highest cell
    owner = np.full(height.shape, -1, np.int32)
    for level in np.append(levels[levels > lowest], lowest):
        basin, count = ndimage.label(height >= level, _TOUCHING)
        if level >= _WIDE:
            new = np.setdiff1d(np.arange(1, count + 1), [basin[peak] for peak in peaks])
            peaks += [tuple(map(int, at)) for at in ndimage.maximum_position(height, basin, new)]
        alive = _persistent(peaks, [int(basin[peak]) for peak in peaks], height, level, narrow)
        owner[~np.isin(owner, alive)] = -1
        own_basin = np.array([basin[peaks[k]] for k in alive])
        alone = np.bincount(own_basin, minlength=count + 1) == 1
        for k, own in zip(alive, own_basin, strict=True):
            if alone[own]:
                owner[(basin == own) & (owner < 0)] = k
        peaks, owner = [peaks[k] for k in alive], _renumbered(owner, alive)
    if len(peaks) < 2:
        return None
    nearest: Any = ndimage.distance_transform_edt(owner < 0, return_distances=False, return_indices=True)
    return np.asarray(owner[tuple(nearest)])


def _height(footprint: NDArray[np.float32]) -> NDArray[np.float64]:
    """(X, Y) half of a width, in cells, times the score over the best."""
    from scipy import ndimage

    seen = footprint > 0
    hole, _ = ndimage.label(ndimage.binary_fill_holes(seen) & ~seen)
    small = np.bincount(hole.ravel()) <= _SMALL_HOLE * np.count_nonzero(seen)
    small[0] = False  # what is no hole
    solid = seen | small[hole]
    fits = np.where(footprint > 0, footprint / footprint.max(), 1.0)
    to_rim = ndimage.distance_transform_edt(np.pad(solid, 1))[1:-1, 1:-1]
    return np.asarray(np.where(solid, (to_rim - 0.5) * fits, 0.0))


def _persistent(
    peaks: list[tuple[int, ...]], basins: list[int], height: NDArray[np.float64], level: float, narrow: float
) -> list[int]:
    """Which peaks are still things of their own at a level: the highest of their basin, or high above it."""
    kept: list[int] = []
    for k in sorted(range(len(peaks)), key=lambda k: -height[peaks[k]]):
        joined = basins[k] in [basins[other] for other in kept]
        if not joined or level <= min(narrow * height[peaks[k]], _NECK):
            kept.append(k)
    return kept


def _renumbered(owner: NDArray[np.int32], alive: list[int]) -> NDArray[np.int32]:
    number = np.full(max(alive, default=-1) + 2, -1, np.int32)
    number[alive] = np.arange(len(alive))
    return number[owner]  # -1 takes the last, which is -1
