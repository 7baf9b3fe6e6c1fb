"""Touching things are separated, and single things are not: on analytic shapes."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from numpy.typing import NDArray
from scenes import occupancy_of
from worded_voxels import WORDS, box, feature, occupancy

from freeocc3d.core.errors import ConfigError
from freeocc3d.query.region_splitting import _footprint, cut_necks, split_footprint
from freeocc3d.query.word_query import Options, query

SHAPE = 60, 60
Rectangle = tuple[int, int, int, int]


def footprint(*rectangles: Rectangle) -> NDArray[np.float32]:
    """Ones in rectangles x0, x1, y0, y1."""
    made = np.zeros(SHAPE, np.float32)
    for x0, x1, y0, y1 in rectangles:
        made[x0:x1, y0:y1] = 1
    return made


def count(made: NDArray[np.float32], narrow: float = 0.5) -> int:
    parts = split_footprint(made, narrow)
    return 1 if parts is None else len(np.unique(parts))


@pytest.mark.parametrize(
    "rectangles",
    [
        ((5, 20, 5, 17), (20, 21, 10, 11), (21, 36, 5, 17)),  # two tables, a voxel between them
        ((5, 20, 5, 17), (20, 23, 10, 12), (23, 36, 5, 17)),
        ((5, 10, 5, 10), (10, 15, 8, 13)),  # two chairs that touch along two voxels
        ((5, 20, 5, 17), (20, 35, 17, 29)),  # across a corner
    ],
)
def test_a_neck_separates_two_things(rectangles: tuple[Rectangle, ...]) -> None:
    made = footprint(*rectangles)
    parts = split_footprint(made, 0.5)
    assert parts is not None
    first, last = rectangles[0], rectangles[-1]
    of_first, of_last = (np.unique(parts[x0:x1, y0:y1]) for x0, x1, y0, y1 in (first, last))
    assert len(of_first) == len(of_last) == 1, "neither thing is cut itself"
    assert of_first != of_last


def test_three_tables_in_a_row_are_three() -> None:
    row = [(x, x + 10, 5, 15) for x in (2, 13, 24)]
    assert count(footprint(*row, (12, 13, 8, 9), (23, 24, 11, 12))) == 3


@pytest.mark.parametrize(
    "rectangles",
    [
        ((5, 30, 5, 14), (5, 14, 5, 30)),  # a sofa like an L
        ((5, 30, 5, 8), (5, 8, 5, 30)),
        ((5, 40, 5, 14), (5, 14, 5, 30), (31, 40, 5, 30)),  # like a U
        ((10, 30, 10, 24), (30, 45, 16, 17)),  # a thing with a long handle
        ((0, 25, 0, 40), (25, 27, 10, 20), (27, 60, 0, 40)),  # two rooms with a door between them
        ((0, 60, 0, 2), (0, 60, 58, 60), (0, 2, 0, 60), (58, 60, 0, 60)),  # the walls of a room
        ((5, 10, 5, 10), (10, 15, 5, 10)),  # what touches along a whole side cannot be told from one thing
    ],
)
def test_single_things_stay_whole(rectangles: tuple[Rectangle, ...]) -> None:
    assert count(footprint(*rectangles)) == 1


@pytest.mark.parametrize("seed", range(4))
def test_convex_things_are_never_cut(seed: int) -> None:
    rng = np.random.default_rng(seed)
    i, j = np.indices(SHAPE)
    for _ in range(25):
        turn, (w, h), (cx, cy) = rng.uniform(0, np.pi), rng.uniform(2, 28, 2), rng.uniform(28, 32, 2)
        x = (i - cx) * np.cos(turn) + (j - cy) * np.sin(turn)
        y = (j - cy) * np.cos(turn) - (i - cx) * np.sin(turn)
        assert count(((np.abs(x) <= w) & (np.abs(y) <= h)).astype(np.float32)) == 1
        assert count(((x / w) ** 2 + (y / h) ** 2 <= 1).astype(np.float32)) == 1


@pytest.mark.parametrize("seed", range(4))
def test_as_many_things_as_there_are_ways_through_necks(seed: int) -> None:
    """Against the definition: the best way between two maxima, found cell by cell."""
    from freeocc3d.query.region_splitting import _NECK, _WIDE, _height

    rng = np.random.default_rng(seed)
    boxes = [(x, x + int(w), y, y + int(h)) for (x, y), (w, h) in zip(rng.integers(0, 40, (7, 2)).tolist(),
             rng.integers(4, 16, (7, 2)).tolist(), strict=True)]  # fmt: skip
    height = _height(footprint(*boxes))
    peaks = []
    for level in np.unique(height[height >= _WIDE])[::-1]:
        cells = {tuple(at) for at in np.argwhere(height >= level).tolist()}
        while cells:
            basin, edge = [], [cells.pop()]
            while edge:
                at = edge.pop()
                basin.append(at)
                around = {(at[0] + di, at[1] + dj) for di, dj in product((-1, 0, 1), repeat=2)} & cells
                cells -= around
                edge += around
            inside = sorted((peak for peak in peaks if peak[1] in basin), reverse=True)
            if not inside and level >= _WIDE:
                best = max(basin, key=lambda cell: height[cell])
                peaks.append((float(height[best]), best))
    saddle_levels = np.unique(height[height > 0])[::-1]
    kept: list[tuple[float, tuple[int, int]]] = []
    for peak in sorted(peaks, reverse=True):
        joins = max((_joined(height, saddle_levels, peak[1], other[1]) for other in kept), default=0.0)
        if joins <= min(0.5 * peak[0], _NECK):
            kept.append(peak)
    assert count(footprint(*boxes)) == max(len(kept), 1)


def _joined(height: NDArray[np.float64], levels: NDArray[np.float64], a: tuple[int, int], b: tuple[int, int]) -> float:
    """The highest level at which two cells are in one basin."""
    from scipy.ndimage import label

    for level in levels:
        basin, _ = label(height >= level, np.ones((3, 3)))
        if basin[a] and basin[a] == basin[b]:
            return float(level)
    return 0.0


def test_a_valley_of_the_score_counts_as_a_neck() -> None:
    made = footprint((5, 35, 5, 11))
    assert count(made) == 1
    made[19:21] *= 0.4
    assert count(made) == 2


def table(x: int, y: int, wide: int = 8, deep: int = 6, high: int = 5) -> dict:
    """A top on four legs."""
    legs = [
        box((i, j, 0), (i + 1, j + 1, high), feature(DINING=1)) for i in (x, x + wide - 1) for j in (y, y + deep - 1)
    ]
    made = box((x, y, high), (x + wide, y + deep, high + 1), feature(DINING=1))
    for leg in legs:
        made |= leg
    return made


def test_tables_that_a_voxel_joins_are_two_regions_with_their_legs() -> None:
    joined = table(0, 0) | box((8, 3, 5), (9, 4, 6), feature(DINING=1)) | table(9, 0)
    room = occupancy(joined)
    (whole,) = query(room, WORDS, ["table"], Options(narrow=0.0))[0].regions
    regions = query(room, WORDS, ["table"])[0].regions
    assert whole.voxels == len(joined)
    assert sorted(np.concatenate([region.rows for region in regions])) == sorted(whole.rows)
    assert sorted(region.voxels for region in regions) == [len(table(0, 0)), len(table(0, 0)) + 1]
    assert len(query(occupancy(table(0, 0)), WORDS, ["table"])[0].regions) == 1


@pytest.mark.parametrize("turn", [0.3, 0.8])
def test_what_is_above_is_asked_not_the_lattice(turn: float) -> None:
    """Tables on a lattice that is tilted against the floor."""
    up = np.array((0.0, -np.sin(turn), np.cos(turn)))
    R = np.array(((1, 0, 0), (0, np.cos(turn), np.sin(turn)), (0, -np.sin(turn), np.cos(turn))))  # level from lattice
    lattice = np.array(list(product(range(-1, 25), range(-16, 20), range(-16, 20))), np.int32)
    x, y, z = ((lattice + 0.5) @ R.T).T
    top = (np.abs(z) <= 0.9) & (y >= 0) & (y <= 9)
    left, right = top & (x >= 0) & (x <= 10), top & (x >= 12) & (x <= 22)
    neck = top & (np.abs(y - 4) <= 0.9) & (x >= 10) & (x <= 12)
    voxels = lattice[left | neck | right]
    made = occupancy_of(voxels)
    order = {tuple(v): n for n, v in enumerate(made.occupied_voxels().tolist())}
    rows = np.array([order[tuple(v)] for v in voxels.tolist()])
    one = np.zeros(len(rows), np.int32)
    part = cut_necks(made, rows, one, np.ones(len(rows), np.float32), up, 0.5)
    on_left = left[left | neck | right]
    assert len(np.unique(part)) == 2
    assert len(np.unique(part[on_left])) == 1
    assert len(np.unique(cut_necks(made, rows, one, np.ones(len(rows), np.float32), up, 0.0))) == 1


def test_a_share_of_a_width_lies_between_0_and_1() -> None:
    with pytest.raises(ConfigError, match="'narrow' must be from 0 to 1, got 1"):
        Options(narrow=1.5)


def test_what_spreads_too_far_stays_whole_and_no_score_is_too_low() -> None:
    line = np.arange(5000)
    made = occupancy_of(np.stack((line, line, 0 * line), axis=1)[::100])
    far = made.replace(keys=made.keys * 40)
    rows = np.arange(50)
    for one, up in ((made, (0.0, 0.0, 1.0)), (far, (0.0, 0.0, 1.0))):
        part = cut_necks(one, rows, np.zeros(50, np.int32), np.full(50, -0.5, np.float32), np.array(up), 0.5)
        assert len(np.unique(part)) == 1


@pytest.mark.parametrize("up", [(0.0, 0.0, 1.0), (0.0, -1.0, 0.0), (1.0, 0.0, 0.0)])
def test_each_voxel_has_its_own_cell_with_the_best_score_above_and_below_it(up: tuple[float, float, float]) -> None:
    rng = np.random.default_rng(0)
    voxels = np.argwhere(rng.random((9, 7, 8)) < 0.4)
    made = occupancy_of(voxels)
    stored, axis = made.occupied_voxels(), int(np.argmax(np.abs(up)))
    scores = rng.uniform(0.1, 1, len(stored)).astype(np.float32)
    cells, footprint = _footprint(made, np.arange(len(stored)), scores, np.array(up))
    assert footprint is not None
    columns = [tuple(column) for column in np.delete(stored, axis, axis=1).tolist()]
    best = {column: max(s for own, s in zip(columns, scores, strict=True) if own == column) for column in columns}
    np.testing.assert_array_equal(footprint[tuple(cells.T)], [best[column] for column in columns])
    assert np.count_nonzero(footprint) == len(best)
    assert len({(*cell, *column) for cell, column in zip(cells.tolist(), columns, strict=True)}) == len(best)
    assert not footprint[[0, -1]].any(), "around them are empty cells"
    assert not footprint[:, [0, -1]].any()
