"""Divides the surface of a map into things by its shape and colors, where no classes are known.

Without floor, walls and ceiling, things meet each other and themselves in corners. A part of the surface without
corners belongs to one thing. Two such parts are one thing if their colors are alike, and the more so, the blunter the
corner between them: a sofa's seat and its back, but not a table and the chair at it, which differ in color.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from ...core.transforms import transform
from ...core.types import Occupancy
from ...storage.saved_map import SavedMap
from .agglomeration import agglomerate
from .object import Segment
from .structure import find_floor, find_structure
from .surfels import Surfels, take_surfels

_SMOOTH, _PART, _THING = 0.17, 0.3, 2.0**0.5
"""Concavity that ends a smooth surface, a part of a thing, and a thing whose parts have one color: corners that turn by
10 degrees (as in LCCP), by 17 degrees, and by a right angle."""
_STEP = 0.35
"""Spacings by which one surface may lie above another without a step: three standard deviations of the Gaussians."""
_DIFFERENT = 10.0
"""CIE76 difference of two colors, with half the lightness because of shading, that are of different things."""
_LIGHTNESS = 0.5
_LEAST_WEIGHT = -4.0  # one corner must not outweigh a long smooth seam


def divide_surface(scan_map: SavedMap, segment: Segment | None = None, most: int = 1) -> NDArray[np.int64]:
    """Returns the (V,) thing of each occupied voxel; -1 for those of floor, walls and ceiling.

    segment: gives the masks of a keyframe, which then divide the surface: those of up to ``most`` keyframes; see
    ``mask_votes``.
    """
    occupancy = scan_map.occupancy
    if not len(scan_map.gaussians):
        return np.full(len(occupancy.occupied_voxels()), -1)
    surfels = take_surfels(scan_map)
    outside = ~_find_bounds(surfels, occupancy, scan_map.T_gravity_map)
    if segment is None:
        thing = _merge_alike(surfels, find_parts(surfels, outside, _PART))
    else:
        thing = _divide_by_masks(scan_map, surfels, outside, segment, most)
    centers = occupancy.centers(occupancy.occupied_voxels(), occupancy.occupied_edges())
    return _vote(surfels.points, thing, transform(scan_map.T_gravity_map, centers))


def divide_surfels(surfels: Surfels, occupancy: Occupancy, T_gravity_map: NDArray[np.float64]) -> NDArray[np.int64]:
    """Returns the (N,) thing of each surfel; -1 for those of floor, walls and ceiling.

    T_gravity_map: (4, 4) from the frame of the occupancy to that of the surfels.
    """
    outside = ~_find_bounds(surfels, occupancy, T_gravity_map)
    return _merge_alike(surfels, find_parts(surfels, outside, _PART))


def _find_bounds(surfels: Surfels, occupancy: Occupancy, T_gravity_map: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Returns the (N,) surfels of floor, walls and ceiling."""
    floor = find_floor(surfels, occupancy.voxel_size)
    smooth = find_parts(surfels, ~floor, _SMOOTH)
    bounds = find_structure(surfels, smooth, occupancy, T_gravity_map) & ~floor
    return np.asarray(floor | (bounds & ~_differs(surfels, np.where(bounds, smooth, -1))))


def _divide_by_masks(
    scan_map: SavedMap,
    surfels: Surfels,
    chosen: NDArray[np.bool_],
    segment: Segment,
    most: int,
) -> NDArray[np.int64]:
    """Returns the (N,) thing of each chosen surfel by the masks of keyframes, -1 for others."""
    from .mask_votes import count_votes, weigh_votes

    pairs = surfels.pairs[chosen[surfels.pairs].all(axis=1)]
    votes = count_votes(scan_map, pairs, segment, most)
    shape = np.clip(_weigh_shape(surfels, pairs, _PART), -1, 1)
    return np.where(chosen, agglomerate(len(surfels), pairs, weigh_votes(*votes, shape)), -1)


def find_parts(surfels: Surfels, chosen: NDArray[np.bool_], concavity: float) -> NDArray[np.int64]:
    """Returns the (N,) part of each chosen surfel, -1 for others: surface without corners or steps."""
    pairs = surfels.pairs[chosen[surfels.pairs].all(axis=1)]
    part = agglomerate(len(surfels), pairs, np.maximum(_weigh_shape(surfels, pairs, concavity), _LEAST_WEIGHT))
    return np.where(chosen, part, -1)


def _weigh_shape(surfels: Surfels, pairs: NDArray[np.int64], concavity: float) -> NDArray[np.float64]:
    """(P,) up to 1, for pairs of one part; negative beyond a concavity, or a step."""
    steps = np.maximum(surfels.steps(pairs) - _STEP, 0)
    return np.asarray(1 - np.maximum(surfels.concavities(pairs), 0) / concavity - steps)


def _differs(surfels: Surfels, wall: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Returns the (N,) surfels that differ in color from their wall: pictures, doors and windows that are flush with
    it. wall: (N,) number of each surfel's wall, -1 for none. A wall has the median color of its surfels.
    """
    _, which = np.unique(wall, return_inverse=True)
    order = np.argsort(which, kind="stable")
    of_wall = np.split(order, np.cumsum(np.bincount(which))[:-1])
    usual = np.stack([np.median(surfels.lab[rows], axis=0) for rows in of_wall])
    return np.asarray((wall >= 0) & (_difference(surfels.lab, usual[which]) > _DIFFERENT))


def _mean_colors(surfels: Surfels, part: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Returns the number of surfels of each part, and its (P, 3) mean color."""
    size = np.bincount(part)
    return size, np.stack([np.bincount(part, values) for values in surfels.lab.T], axis=1) / size[:, None]


def _difference(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns the (N,) differences of (N, 3) CIELAB colors, with less weight of the lightness."""
    return np.asarray(np.linalg.norm((a - b) * (_LIGHTNESS, 1, 1), axis=1))


def _merge_alike(surfels: Surfels, part: NDArray[np.int64]) -> NDArray[np.int64]:
    """Returns the (N,) thing of each surfel: parts whose colors are alike and that meet in blunt corners."""
    number, part = np.unique(part, return_inverse=True)
    size, lab = _mean_colors(surfels, part)
    none = number[0] < 0
    pairs = surfels.pairs[~(none & (part[surfels.pairs] == 0)).any(axis=1)]
    a, b = part[pairs].T
    between = a != b
    pairs, a, b = pairs[between], a[between], b[between]
    corners = np.maximum(surfels.concavities(pairs), 0)
    weights = 1 - corners / _THING - _difference(lab[a], lab[b]) / _DIFFERENT
    thing = agglomerate(len(size), np.stack((a, b), axis=1), weights)[part]
    return np.where(none & (part == 0), -1, thing)


def _vote(points: NDArray[np.float64], thing: NDArray[np.int64], centers: NDArray[np.float64]) -> NDArray[np.int64]:
    """Returns the (V,) thing of each voxel: that of most surfels to which it is the nearest voxel; if there are none,
    that of the nearest surfel."""
    voxel = KDTree(centers).query(points)[1]
    votes, count = np.unique(np.stack((voxel, thing), axis=1), axis=0, return_counts=True)
    order = np.argsort(count, kind="stable")  # of each voxel the last, the most frequent, stays
    found = thing[KDTree(points).query(centers)[1]]
    found[votes[order, 0]] = votes[order, 1]
    return found
