"""How the objects of a scene stand to each other: on, in, next to, and against a wall. The module imports little, to
start fast.

The definitions are physical, and free of names. What a camera does not see of a contact, such as the wall behind a
wardrobe, is judged by what it sees beside it. Sources: on, next to and in as in 3D scene graphs, J. Wald et al.,
Learning 3D Semantic Scene Graphs from 3D Indoor Reconstructions, CVPR 2020, which were labeled by hand; here each has a
measure.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ...core.transforms import transform
from ...core.types import Occupancy
from ..conditions import SolidVoxels
from .object import Object

_CARRIED = 0.25
"""Least share of an underside that stands over the thing that carries it. Less is an edge that reaches over it."""
_AROUND = 0.5
"""Least share of the rim around an underside that is the carrier's top: what a thing stands on is hidden below it."""
_INSIDE = 0.5  # least share of the voxels that the other thing encloses
_SIDES = 3  # of the four level directions: a niche is open in front
_NEXT_M = 0.5
"""Largest gap between things next to each other; small things must be as near as they are long."""
_WALL = 0.4
"""Least height of a wall, as a share of the map's height: 1 m in a common room, higher than tables and backs of chairs.
"""
_AGAINST_M = 0.1  # a skirting board, a cable
_AGAINST_VOXELS = 1.5  # the surfaces of both are rounded to voxels
_BEYOND = 0.5  # of a side's length, beyond either end: the wall behind a wardrobe is seen only beside it
_ALONG = 0.5  # least length of the wall there, as a share of the side's


@dataclass(frozen=True)
class Relation:
    """How an object stands to another or to a wall.

    kind: "on": at least a quarter of its underside stands over voxels of the other, at most 1.5 voxels above them; or
    at least half of the cells around its underside, as seen from above, are the other's top at that height.
    "in": at least half of its voxels have voxels of the other below them and on three of four sides.  "next to": the
    gap is no more than 0.5 m and no more than the smaller thing's longest edge, the two share a range of heights, and
    neither is on or in the other.  "against": a wall runs along one side of its box, at most 0.1 m or 1.5 voxels away.
    other: the number of the other object, from 0; None for a wall.  gap_m: meters between them; 0 for "on" and "in".
    """

    kind: Literal["on", "in", "next to", "against"]
    other: int | None
    gap_m: float = 0.0


def find_relations(
    occupancy: Occupancy, objects: Sequence[Object], T_gravity_map: NDArray[np.float64], metric: bool = True
) -> list[list[Relation]]:
    """Returns the relations of each object: "in" and "on", "against", then "next to", nearest first.

    T_gravity_map: (4, 4) rigid, to a frame with z up and the floor at z = 0.  metric: whether lengths are meters; if
    not, only the sizes of things and voxels limit gaps. Of two things that interlock, the higher is on the lower.
    """
    there = SolidVoxels(occupancy, T_gravity_map[2, :3])
    count = len(objects)
    longest = np.array([thing.box.extent.max() for thing in objects])
    reach = np.minimum(np.minimum(longest[:, None], longest), _NEXT_M if metric else np.inf).reshape(count, count)
    inner, outer = _candidates(there, objects, reach)
    held: list[list[Relation]] = [[] for _ in objects]
    resting = np.zeros((count, count), bool)
    for i, j in zip(inner, outer, strict=True):
        own, others = objects[i].rows, objects[j].rows
        if _share_enclosed(there, own, others) >= _INSIDE:
            kind: Literal["in", "on"] = "in"
        elif there.supported(own, others).mean() >= _CARRIED or _share_of_rim(there, own, others) >= _AROUND:
            kind = "on"
        else:
            continue
        if resting[j, i]:
            if objects[i].centroid @ T_gravity_map[2, :3] <= objects[j].centroid @ T_gravity_map[2, :3]:
                continue
            held[j] = [relation for relation in held[j] if relation.other != i]
        resting[i, j] = True
        held[i].append(Relation(kind, int(j)))
    walls = _wall_cells(there, objects, T_gravity_map)
    reach[resting | resting.T] = -1
    gaps = _gaps(there, objects, inner, outer, reach)
    most = max(_AGAINST_M * metric, _AGAINST_VOXELS * occupancy.voxel_size)
    related = []
    for i, thing in enumerate(objects):
        own = sorted(held[i], key=lambda relation: relation.kind)  # "in" before "on"
        gap = _gap_to_wall(thing, walls, occupancy.voxel_size, T_gravity_map, most)
        if gap is not None:
            own.append(Relation("against", None, gap))
        near = np.flatnonzero(np.isfinite(gaps[i]))
        own += [Relation("next to", int(j), float(gaps[i, j])) for j in near[np.argsort(gaps[i, near], kind="stable")]]
        related.append(own)
    return related


def _candidates(
    there: SolidVoxels, objects: Sequence[Object], reach: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Returns the ordered pairs of objects with boxes, in a level frame, that are as near as some relation allows."""
    spans = [there.level(thing.rows) for thing in objects]
    low = np.array([(at - edges[:, None] / 2).min(axis=0) for at, edges in spans]).reshape(-1, 3)
    high = np.array([(at + edges[:, None] / 2).max(axis=0) for at, edges in spans]).reshape(-1, 3)
    apart = np.maximum(np.maximum(low[:, None] - high[None], low[None] - high[:, None]), 0)
    near = np.linalg.norm(apart, axis=2) <= np.maximum(reach, 2 * there.occupancy.voxel_size)
    np.fill_diagonal(near, False)
    first, second = np.nonzero(near)
    return first, second


def _share_enclosed(there: SolidVoxels, rows: NDArray[np.int64], others: NDArray[np.int64]) -> float:
    """Returns the share of voxels that have some of the others below them, and on three of four level sides."""
    size = there.occupancy.voxel_size
    mine, theirs = there.level(rows)[0], there.level(others)[0]
    low, high = theirs.min(axis=0) - size / 2, theirs.max(axis=0) + size / 2
    within = ((mine > low) & (mine < high)).all(axis=1)
    if within.mean() < _INSIDE:
        return 0.0
    grid = np.zeros(tuple(np.ceil((high - low) / size).astype(np.int64) + 1), bool)
    grid[tuple(np.floor((theirs - low) / size).astype(np.int64).T)] = True
    cells = tuple(np.floor((mine[within] - low) / size).astype(np.int64).T)

    def hidden(axis: int, step: int) -> NDArray[np.bool_]:
        """Whether the others have a voxel beside each of mine, along an axis from its start or its end."""
        along = np.flip(grid, axis) if step < 0 else grid
        reached = np.logical_or.accumulate(along, axis=axis)
        return np.asarray((np.flip(reached, axis) if step < 0 else reached)[cells])

    sides = sum(hidden(axis, step).astype(int) for axis in (0, 1) for step in (1, -1))
    return float(np.count_nonzero((sides >= _SIDES) & hidden(2, 1)) / len(rows))


def _share_of_rim(there: SolidVoxels, rows: NDArray[np.int64], others: NDArray[np.int64]) -> float:
    """Returns the share of the cells around the underside of voxels, as seen from above, that are tops of the others at
    its height, up to a voxel higher or lower."""
    from scipy import ndimage

    size = there.occupancy.voxel_size
    mine, theirs = there.level(rows)[0], there.level(others)[0]
    low = theirs.min(axis=0) - size / 2
    own, cells = (np.floor((at - low) / size).astype(np.int64) for at in (mine, theirs))
    bottom = own[:, 2].min()
    if not 0 <= bottom <= cells[:, 2].max() + 2:
        return 0.0
    under = own[own[:, 2] <= bottom + 1, :2]
    shift = np.minimum(under.min(axis=0), 0) - 1
    shape = tuple(np.maximum(under.max(axis=0), cells[:, :2].max(axis=0)) - shift + 2)
    footprint, top = np.zeros(shape, bool), np.full(shape, -9)
    footprint[tuple((under - shift).T)] = True
    np.maximum.at(top, tuple((cells[:, :2] - shift).T), cells[:, 2])
    rim = ndimage.binary_dilation(footprint) & ~footprint
    return float((np.abs(top[rim] + 1 - bottom) <= 1).mean())


def _gaps(
    there: SolidVoxels,
    objects: Sequence[Object],
    first: NDArray[np.int64],
    second: NDArray[np.int64],
    reach: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Returns the (N, N) gaps between things next to each other, meters; infinite for all other pairs. reach: (N, N)
    greatest gaps, less than 0 for pairs that are not next to each other."""
    from scipy.spatial import KDTree

    size = there.occupancy.finest
    points = [there.lattice_points(thing.rows) for thing in objects]
    trees: dict[int, KDTree] = {}
    heights = [there.level(thing.rows) for thing in objects]
    spans = np.array([((at[:, 2] - e / 2).min(), (at[:, 2] + e / 2).max()) for at, e in heights]).reshape(-1, 2)
    gaps = np.full((len(objects), len(objects)), np.inf)
    for i, j in zip(first, second, strict=True):
        shared = min(spans[i, 1], spans[j, 1]) - max(spans[i, 0], spans[j, 0])
        if reach[i, j] < 0 or len(points[i]) > len(points[j]) or (len(points[i]) == len(points[j]) and i > j):
            continue  # each pair once, from the one of fewer points
        if shared < 0.5 * there.occupancy.voxel_size:
            continue
        if j not in trees:
            trees[j] = KDTree(points[j])
        most = reach[i, j] / size * (1 + 1e-9)
        gap = trees[j].query(points[i], distance_upper_bound=most)[0].min() * size
        gaps[i, j] = gaps[j, i] = gap
    return gaps


def _wall_cells(
    there: SolidVoxels, objects: Sequence[Object], T_gravity_map: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Returns the (C, 2) middles of the cells of the floor plan, gravity frame, over which voxels of no object reach a
    wall's height. A cell is as large as the largest voxel."""
    occupancy = there.occupancy
    size = occupancy.voxel_size
    at = transform(T_gravity_map, occupancy.centers(there.voxels, there.edges))
    free = np.ones(len(at), bool)
    for thing in objects:
        free[thing.rows] = False
    free &= at[:, 2] > 1.5 * size  # not the floor
    if not free.any():
        return np.zeros((0, 2))
    top = float(np.percentile(at[:, 2], 99))
    cell = np.floor(at[free] / size + 1e-6).astype(np.int64)
    plan = np.unique(np.unique(cell, axis=0)[:, :2], axis=0, return_counts=True)
    return np.asarray((plan[0][plan[1] * size >= _WALL * top] + 0.5) * size, np.float64)


def _gap_to_wall(
    thing: Object, walls: NDArray[np.float64], size: float, T_gravity_map: NDArray[np.float64], most: float
) -> float | None:
    """Returns the gap, up to ``most``, between a side of a thing's box and the wall that runs along it, or None."""
    if not len(walls):
        return None
    T_gravity_box = T_gravity_map @ thing.box.T_map_box
    own = (walls - T_gravity_box[:2, 3]) @ T_gravity_box[:2, :2]  # in the box's frame
    half = thing.box.extent[:2] / 2
    gaps = []
    for axis, sign in ((0, -1), (0, 1), (1, -1), (1, 1)):
        out = sign * own[:, axis] - size / 2 - half[axis]
        along = np.abs(own[:, 1 - axis])
        beside = (out >= -most) & (out <= most) & (along <= (1 + 2 * _BEYOND) * half[1 - axis] + size / 2)
        columns = np.unique(np.floor(own[beside, 1 - axis] / size))
        if len(columns) * size >= 2 * _ALONG * half[1 - axis]:
            gaps.append(max(float(np.median(out[beside])), 0.0))
    return min(gaps, default=None)
