"""Conditions on places: tiny rooms with known answers, and plain loops over all pairs of voxels."""

from __future__ import annotations

import numpy as np
import pytest
from worded_voxels import SIZE, WORDS, box, feature, occupancy

from freeocc3d.core.errors import ConfigError, FreeOccError, MapError
from freeocc3d.core.types import BLOCK, OCCUPIED, Occupancy
from freeocc3d.query.conditions import SolidVoxels, Where, _References, near_word, only_where
from freeocc3d.query.regions import Region
from freeocc3d.query.word_query import Options, query

UP = np.array((0.0, 0.0, 1.0))
TABLE = box((0, 0, 0), (6, 6, 4), feature(DINING=1))
ON_TABLE = box((1, 1, 4), (3, 3, 6), feature(CUP=1))
BESIDE = box((8, 0, 0), (9, 2, 2), feature(CUP=1))
FAR = box((30, 0, 20), (32, 2, 23), feature(CUP=1))


def asked(room: Occupancy, word: str, where: Where, top_k: int = 20, up: np.ndarray = UP) -> list[tuple[float, ...]]:
    """Lower corners of the regions that remain, in voxels."""
    return [tuple(np.rint(r.box_min / SIZE).astype(int)) for r in answer(room, word, where, top_k, up).regions]


def answer(room: Occupancy, word: str, where: Where, top_k: int = 20, up: np.ndarray = UP):
    every = Options(top_k=10**8)  # more regions than any map has voxels
    references = query(room, WORDS, where.words, every) if where.words else []
    return only_where(room, up, query(room, WORDS, [word], every), references, where, top_k)[0]


@pytest.fixture(scope="module")
def room() -> Occupancy:
    return occupancy(TABLE | ON_TABLE | BESIDE | FAR)


def test_within_takes_regions_whose_centroid_is_in_the_box(room) -> None:
    assert asked(room, "cup", Where(within=(0.0, 0.0, 0.0, 1.0, 1.0, 1.0))) == [(1, 1, 4), (8, 0, 0)]
    assert asked(room, "cup", Where(within=(0.7, 0.0, 0.0, 1.0, 1.0, 1.0))) == [(8, 0, 0)]
    with pytest.raises(MapError, match="outside of the map"):
        answer(room, "cup", Where(within=(9.0, 9.0, 9.0, 10.0, 10.0, 10.0)))


def test_near_measures_the_gap_between_faces(room) -> None:
    assert asked(room, "cup", Where(near="table", near_m=0.0)) == [(1, 1, 4)]
    assert asked(room, "cup", Where(near="table", near_m=0.19)) == [(1, 1, 4)]
    assert asked(room, "cup", Where(near="table", near_m=0.2)) == [(1, 1, 4), (8, 0, 0)]
    assert len(asked(room, "cup", Where(near="table", near_m=100.0))) == 3


def test_on_takes_what_stands_on_it_whichever_way_is_up(room) -> None:
    assert asked(room, "cup", Where(on="table")) == [(1, 1, 4)]
    assert asked(room, "cup", Where(on="table"), up=-UP) == []
    assert asked(room, "table", Where(on="cup"), up=-UP) == [(0, 0, 0)]
    tilted = np.array((0.05, -0.08, 1.0))
    assert asked(room, "cup", Where(on="table"), up=tilted / np.linalg.norm(tilted)) == [(1, 1, 4)]


@pytest.mark.parametrize(("gap", "stands"), [(0, True), (1, True), (2, False)])
def test_on_bridges_a_voxel_that_was_not_mapped(gap: int, stands: bool) -> None:
    room = occupancy(TABLE | box((1, 1, 4 + gap), (3, 3, 6 + gap), feature(CUP=1)))
    assert bool(asked(room, "cup", Where(on="table"))) == stands


def test_what_leans_against_a_thing_or_hangs_next_to_it_is_not_on_it() -> None:
    leans = box((6, 0, 0), (7, 4, 6), feature(CUP=1))
    hangs = box((5, 0, -4), (6, 2, 0), feature(CUP=1))
    room = occupancy(TABLE | leans)
    assert asked(room, "cup", Where(on="table")) == []
    assert asked(occupancy(TABLE | hangs), "cup", Where(on="table")) == []


def test_picks(room) -> None:
    assert asked(room, "cup", Where(pick="largest")) == [(30, 0, 20)]
    assert asked(room, "cup", Where(pick="highest")) == [(30, 0, 20)]
    assert asked(room, "cup", Where(pick="lowest")) == [(8, 0, 0)]
    assert asked(room, "cup", Where(pick="highest"), up=-UP) == [(8, 0, 0)]
    assert asked(room, "cup", Where(pick="largest", near="table")) == [(1, 1, 4)]
    best = query(room, WORDS, ["cup"])[0].regions[0]
    assert answer(room, "cup", Where(pick="best")).regions[0].score == best.score


def test_conditions_are_met_before_the_best_are_taken(room) -> None:
    assert asked(room, "cup", Where(within=(0.7, 0.0, 0.0, 1.0, 1.0, 1.0)), top_k=1) == [(8, 0, 0)]


def test_a_thing_is_not_near_or_on_itself() -> None:
    one = occupancy(ON_TABLE)
    assert asked(one, "cup", Where(near="cup", near_m=50.0)) == []
    two = occupancy(ON_TABLE | BESIDE)
    assert len(asked(two, "cup", Where(near="cup", near_m=50.0))) == 2


def test_a_note_says_which_condition_nothing_met(room) -> None:
    result = answer(room, "cup", Where(near="wall"))
    assert not result.matched
    assert result.note == (
        "'cup' matches 3 regions, but none is within 0.5 m of 'wall', which nothing in this map matches."
    )
    assert answer(room, "cup", Where(near="unicorn")).note.endswith("'unicorn', which is not understood.")
    both = answer(room, "cup", Where(within=(-9.0, -9.0, -9.0, 9.0, 9.0, 9.0), near="wall")).note
    assert both.startswith("'cup' matches 3 regions, but none is within -9 -9 -9 9 9 9 and within 0.5 m of 'wall'")
    assert "'unicorn' is not understood" in answer(room, "unicorn", Where(on="table")).note


def mixed(seed: int, apart: float, density: float = 0.05) -> tuple[Occupancy, Region, Region]:
    """Two random regions of voxels of two sizes; the second lies the farther away the larger ``apart`` is."""
    rng = np.random.default_rng(seed)
    keys = np.array([(0, 0, 0), (2, 0, 0), (1, 1, 0)], np.int32)
    levels = np.array((0, 1, 0), np.uint8)
    keys[1, 0] += 2 * int(apart)
    state = np.where(rng.random((3, BLOCK**3)) < density, OCCUPIED, 0).astype(np.uint8)
    counts = np.zeros(state.shape, np.uint16)
    made = Occupancy(
        SIZE, np.array((0.3, 0.1, -2.0)), keys, np.ones(state.shape, np.float32), counts, counts, state, levels=levels
    )
    rows = np.arange(np.count_nonzero(state))
    mine = rng.random(len(rows)) < 0.5

    def region(own: np.ndarray) -> Region:
        return Region(1.0, 1.0, np.zeros(3), np.zeros(3), np.ones(3), 1.0, own)

    return made, region(rows[mine]), region(rows[~mine])


def gap(made: Occupancy, a: Region, b: Region) -> float:
    voxels, edges = made.occupied_voxels(), made.occupied_edges()
    least = np.inf
    for i in a.rows:
        for j in b.rows:
            beyond = np.maximum(voxels[j] - voxels[i] - edges[i], voxels[i] - voxels[j] - edges[j])
            least = min(least, float(np.linalg.norm(np.maximum(beyond, 0) * made.finest)))
    return least


@pytest.mark.parametrize("seed", range(6))
def test_gaps_are_those_of_all_pairs_in_a_map_of_two_sizes(seed: int) -> None:
    made, a, b = mixed(seed, apart=seed)
    a, b = (Region(1.0, 1.0, r.centroid, r.box_min, r.box_max, 1.0, r.rows[::3]) for r in (a, b))
    true, space = gap(made, a, b), SolidVoxels(made, UP)
    assert space.near(a, _References(space, [b]), true)
    if true > 0:
        assert not space.near(a, _References(space, [b]), true - 0.01 * SIZE)


@pytest.mark.parametrize("seed", range(12))
def test_standing_on_is_that_of_all_pairs_in_a_map_of_two_sizes(seed: int) -> None:
    made, a, b = mixed(seed, apart=0, density=0.2)
    voxels, edges = made.occupied_voxels(), made.occupied_edges()
    raised = a.rows[voxels[a.rows, 2] >= 6]
    a = Region(1.0, 1.0, a.centroid, a.box_min, a.box_max, 1.0, raised)
    b = Region(1.0, 1.0, b.centroid, b.box_min, b.box_max, 1.0, b.rows[:: 1 + 4 * (seed % 6)])
    low = voxels[a.rows, 2].min()
    stands = False
    for i in a.rows[voxels[a.rows, 2] <= low + 2]:  # two of the finest voxels are one of the largest
        for j in b.rows:
            over = (voxels[i] < voxels[j] + edges[j])[:2].all() and (voxels[j] < voxels[i] + edges[i])[:2].all()
            stands |= bool(over and -1 < voxels[i, 2] - voxels[j, 2] - edges[j] < 3)
    space = SolidVoxels(made, UP)
    assert space.on(a, _References(space, [b])) == stands


@pytest.mark.parametrize(
    "bad",
    [
        {"within": (0.0, 0.0, 0.0, 1.0, 1.0, 0.0)},
        {"within": (0.0, 0.0, 0.0, 1.0, 1.0, float("nan"))},
        {"near_m": -1.0},
        {"near_m": float("inf")},
        {"pick": "nearest"},
    ],
)
def test_conditions_that_make_no_sense_are_refused(bad: dict) -> None:
    with pytest.raises(ConfigError):
        Where(**bad)


def test_near_reads_word_and_meters() -> None:
    assert near_word("sink") == ("sink", 0.5)
    assert near_word("coffee table:1.5") == ("coffee table", 1.5)
    with pytest.raises(ConfigError, match="as in sink"):
        near_word("sink:close")


def test_negative_words_take_away_what_fits_them_better_even_if_the_word_includes_it() -> None:
    room = occupancy(
        box((0, 0, 0), (2, 2, 2), feature(COFFEE=1))
        | box((5, 0, 0), (7, 2, 2), feature(DINING=1))
        | box((9, 0, 0), (11, 2, 2), feature(COFFEE=0.5, DINING=0.55))
    )
    assert len(query(room, WORDS, ["table"])[0].regions) == 3
    left = query(room, WORDS, ["table"], negative=["coffee table"])[0].regions
    assert sorted(region.box_min[0] for region in left) == pytest.approx([0.5, 0.9])
    assert len(query(room, WORDS, ["table"], negative=["sofa"])[0].regions) == 3
    with pytest.raises(FreeOccError, match="'tables' is 'table' to this map, which is asked for and excluded"):
        query(room, WORDS, ["table"], negative=["tables"])
    with pytest.raises(FreeOccError, match="'unicorn' cannot be excluded"):
        query(room, WORDS, ["table"], negative=["unicorn"])
    with pytest.raises(FreeOccError, match="empty"):
        query(room, WORDS, ["table"], negative=[" "])
