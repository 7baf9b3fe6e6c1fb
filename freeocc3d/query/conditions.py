"""Conditions on the place of regions: in a box, or near or on what another word finds. The module imports little, to
start fast."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.errors import ConfigError, MapError
from ..core.types import Occupancy
from ..core.voxel_keys import pack_voxels
from .regions import Region
from .word_query import QueryResult

PICKS = ("largest", "highest", "lowest", "best")
_ON_GAP = -0.5, 1.5  # voxels: a tilted lattice rounds surfaces up or down
_LOWEST = 1.0 + 1e-6  # voxels above a region's lowest point that belong to its underside
_OVERLAP = 1.0 - 1e-6
_FARTHEST_M = 1e6

_Condition = tuple[Callable[[Region], bool], str]


@dataclass(frozen=True)
class Where:
    """Conditions on regions. A region must meet all of them.

    within: x0, y0, z0, x1, y1, z1, map frame, meters: the centroid lies in this box.
    near, near_m: the gap between some voxel of the region and some voxel that the word matches is no more than near_m
    meters.
    on: some voxel of the region's underside stands over a voxel that the word matches: they overlap as seen from above,
    and the vertical gap is no more than 1.5 of the map's largest voxels. The underside holds the voxels whose lower
    face is no more than one voxel above the region's lowest face.
    pick: keeps only the "largest" (volume), "highest", "lowest" (centroid) or "best" (score) of the remaining regions.
    A region that ``near`` or ``on`` finds does not count for a region that shares a voxel with it: they are the same.
    """

    within: tuple[float, float, float, float, float, float] | None = None
    near: str | None = None
    near_m: float = 0.5
    on: str | None = None
    pick: str | None = None

    def __post_init__(self) -> None:
        if self.within is not None and not (
            len(self.within) == 6
            and np.less_equal(np.abs(self.within), _FARTHEST_M).all()
            and np.less(self.within[:3], self.within[3:]).all()
        ):
            raise ConfigError(
                "'within' takes a lower and an upper corner, x0 y0 z0 x1 y1 z1 in meters, with x0 < x1, y0 < y1 and "
                f"z0 < z1, at most {_FARTHEST_M:g} m from the origin; got "
                f"{' '.join(f'{value:g}' for value in self.within)}."
            )
        if not 0 <= self.near_m <= _FARTHEST_M:
            raise ConfigError(f"'near' takes a distance of 0 to {_FARTHEST_M:g} meters, got {self.near_m:g}.")
        if self.pick not in (None, *PICKS):
            raise ConfigError(f"'pick' must be one of {', '.join(PICKS)}, got '{self.pick}'.")

    @property
    def words(self) -> list[str]:
        """The words that the conditions need answers for, in addition to the words of the question."""
        return [word for word in (self.near, self.on) if word is not None]


def near_word(text: str) -> tuple[str, float]:
    """Reads word and meters from "WORD" or "WORD:METERS". Raises ConfigError."""
    word, separator, distance = text.rpartition(":")
    if not separator:
        return text, Where.near_m
    try:
        return word, float(distance)
    except ValueError as error:
        raise ConfigError(f"'near' takes a word and meters, as in sink:0.5, got '{text}'.") from error


def only_where(
    occupancy: Occupancy,
    up: NDArray[np.float64],
    results: Sequence[QueryResult],
    references: Sequence[QueryResult],
    where: Where,
    top_k: int,
) -> list[QueryResult]:
    """Returns the results with only the regions that meet the conditions, up to ``top_k`` for each.

    up: (3,) unit vector, map frame.  references: the answers to ``where.words``. Raises MapError for a box outside of
    the map.
    """
    there = SolidVoxels(occupancy, up)
    if where.within is not None:
        there.refuse_outside(where.within)
    conditions = _conditions(there, where, dict(zip(where.words, references, strict=True)))
    narrowed = []
    for result in results:
        regions, note, told = result.regions, result.note, []
        for kept, condition in conditions:
            if not regions:
                break
            told.append(condition)
            regions = [region for region in regions if kept(region)]
        if result.regions and not regions:
            count = f"{len(result.regions)} region{'s' if len(result.regions) > 1 else ''}"
            note = f"'{result.understood}' matches {count}, but none is {' and '.join(told)}."
        narrowed.append(replace(result, regions=_picked(regions, where.pick, up)[:top_k], note=note))
    return narrowed


def _conditions(
    there: SolidVoxels, where: Where, by_word: dict[str, QueryResult]
) -> list[tuple[Callable[[Region], bool], str]]:
    """Returns, for each condition, a test of a region and the words for a note."""
    conditions: list[tuple[Callable[[Region], bool], str]] = []
    if where.within is not None:
        low, high = np.array(where.within).reshape(2, 3)
        inside = f"within {' '.join(f'{value:g}' for value in where.within)}"
        conditions.append((lambda r: bool(((r.centroid >= low) & (r.centroid <= high)).all()), inside))
    if where.near is not None:
        near = by_word[where.near]
        those_near = _References(there, near.regions)
        told = f"within {where.near_m:g} m of '{where.near}'" + _absent(near)
        conditions.append((lambda r: there.near(r, those_near, where.near_m), told))
    if where.on is not None:
        on = by_word[where.on]
        those_below = _References(there, on.regions)
        conditions.append((lambda r: there.on(r, those_below), f"on '{where.on}'" + _absent(on)))
    return conditions


def _absent(reference: QueryResult) -> str:
    if reference.matched:
        return ""
    return ", which nothing in this map matches" if reference.understood else ", which is not understood"


def _picked(regions: list[Region], pick: str | None, up: NDArray[np.float64]) -> list[Region]:
    """Returns the picked region alone, or all regions without a pick."""
    if pick is None or not regions:
        return regions
    values = {
        "largest": lambda region: region.volume_m3,
        "highest": lambda region: float(region.centroid @ up),
        "lowest": lambda region: -float(region.centroid @ up),
        "best": lambda region: region.score,
    }
    return [max(regions, key=values[pick])]


class SolidVoxels:
    """The occupied voxels as solid cubes."""

    def __init__(self, occupancy: Occupancy, up: NDArray[np.float64]):
        self.occupancy = occupancy
        self.voxels, self.edges = occupancy.occupied_voxels(), occupancy.occupied_edges()
        first = np.eye(3)[np.argmin(np.abs(up))]  # the most nearly level axis of the lattice
        first = first - (first @ up) * up
        first /= np.linalg.norm(first)
        self.R_level_map = np.stack((first, np.cross(up, first), up))

    def refuse_outside(self, within: Sequence[float]) -> None:
        """Raises MapError if the box does not overlap the box around all occupied voxels."""
        if not len(self.voxels):
            return
        size, origin = self.occupancy.finest, self.occupancy.origin
        low = origin + self.voxels.min(axis=0) * size
        high = origin + (self.voxels + self.edges[:, None]).max(axis=0) * size
        if (np.array(within[:3]) > high).any() or (np.array(within[3:]) < low).any():
            spans = f"{' '.join(f'{v:.2f}' for v in low)} to {' '.join(f'{v:.2f}' for v in high)}"
            raise MapError(f"The box of 'within' lies outside of the map, which reaches from {spans} m.")

    def near(self, region: Region, references: _References, distance: float) -> bool:
        """Whether the gap between some voxel of each is no more than ``distance`` meters."""
        # For two cubes of a lattice, some pair of their lattice points is as near as the cubes are.
        reach = distance / self.occupancy.finest * (1 + 1e-9) + 1e-9
        tree = references.tree(references.shared(region))
        gaps = tree.query(self.lattice_points(region.rows), distance_upper_bound=reach)[0]
        return bool(np.isfinite(gaps).any())

    def on(self, region: Region, references: _References) -> bool:
        """Whether some voxel of the underside stands over a voxel of the references; see ``Where``."""
        return bool(self.supported(region.rows, references.apart(references.shared(region))).any())

    def supported(self, rows: NDArray[np.int64], others: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Returns, for each voxel of the underside of voxels, whether it stands over one of the others; see ``Where``.
        rows: (n,) and others: (m,), rows of occupied voxels."""
        size = self.occupancy.voxel_size
        mine, edges = self.level(rows)
        bottom = mine[:, 2] - edges / 2
        under = bottom <= bottom.min(initial=np.inf) + _LOWEST * size
        mine, edges = mine[under], edges[under]
        theirs, their_edges = self.level(others)
        stands = np.zeros(len(mine), bool)
        middle, half = sum(_ON_GAP) / 2 * size, (_ON_GAP[1] - _ON_GAP[0]) / 2 * size
        for edge in np.unique(edges):
            for their_edge in np.unique(their_edges):
                reach = (edge + their_edge) / 2
                scale = 1.0, 1.0, reach / half  # makes one distance of all three conditions
                above = (mine[edges == edge] - (0.0, 0.0, reach + middle)) * scale
                below = theirs[their_edges == their_edge] * scale
                below = below[((below > above.min(axis=0) - reach) & (below < above.max(axis=0) + reach)).all(axis=1)]
                gaps = _tree(below).query(above, p=np.inf, distance_upper_bound=reach * _OVERLAP)[0]
                stands[edges == edge] |= np.isfinite(gaps)
        return stands

    @functools.cached_property
    def _every_level(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Returns (V, 3) centers in a frame with z up, and (V,) edges, meters."""
        centers = self.occupancy.centers(self.voxels, self.edges)
        return centers @ self.R_level_map.T, np.asarray(self.edges * self.occupancy.finest, np.float64)

    def level(self, rows: NDArray[np.int64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Returns the (n, 3) centers and (n,) edges of voxels, meters, in a frame with z up."""
        centers, edges = self._every_level
        return centers[rows], edges[rows]

    def lattice_points(self, rows: NDArray[np.int64]) -> NDArray[np.int32]:
        """Returns the (P, 3) distinct points of the finest lattice in and on voxels."""
        points = [np.zeros((0, 3), np.int32)]
        for edge in np.unique(self.edges[rows]).tolist():
            steps = np.indices((edge + 1,) * 3, np.int32).reshape(3, -1).T
            lower = self.voxels[rows[self.edges[rows] == edge]]
            points.append((lower[:, None] + steps).reshape(-1, 3))
        every = np.concatenate(points)
        return every[np.unique(pack_voxels(every), return_index=True)[1]]


class _References:
    """The regions of a word that a condition names."""

    def __init__(self, there: SolidVoxels, regions: Sequence[Region]):
        self._regions = regions
        self._owner = np.full(len(there.voxels), -1, np.int64)
        for number, region in enumerate(regions):
            self._owner[region.rows] = number
        self.apart = functools.lru_cache(maxsize=2)(self._rows_of_others)
        self.tree = functools.lru_cache(maxsize=2)(lambda shared: _tree(there.lattice_points(self.apart(shared))))

    def shared(self, region: Region) -> tuple[int, ...]:
        """Returns the numbers of the references that share a voxel with the region; mostly there are none."""
        own = np.unique(self._owner[region.rows])
        return tuple(own[own >= 0].tolist())

    def _rows_of_others(self, shared: tuple[int, ...]) -> NDArray[np.int64]:
        """Returns the rows of the voxels of all other references."""
        others = (region.rows for number, region in enumerate(self._regions) if number not in shared)
        return np.concatenate([np.zeros(0, np.int64), *others])


def _tree(points: NDArray[np.generic]) -> Any:
    from scipy.spatial import KDTree

    return KDTree(points)
