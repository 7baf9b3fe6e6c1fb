"""Maps of several voxel sizes resampled to one, by blocks, against the same voxel by voxel."""

import numpy as np
import pytest

from freeocc3d.core.types import FREE, OCCUPIED, UNKNOWN, Occupancy
from freeocc3d.occupancy import levels


def some_map(keys: np.ndarray, block_levels: np.ndarray, seed: int = 0) -> Occupancy:
    """Blocks of anything."""
    rng = np.random.default_rng(seed)
    state = rng.choice([FREE, OCCUPIED, UNKNOWN], (len(keys), 512), p=[0.5, 0.2, 0.3]).astype(np.uint8)
    count = int((state == OCCUPIED).sum())
    features = rng.normal(size=(count, 3))
    return Occupancy(
        voxel_size=0.08,
        origin=np.array((1.0, -2.0, 0.5)),
        keys=keys.astype(np.int32),
        probability=rng.random(state.shape, np.float32),
        free=rng.integers(0, 9, state.shape).astype(np.uint16),
        hits=rng.integers(0, 9, state.shape).astype(np.uint16),
        state=state,
        features=(features / np.linalg.norm(features, axis=1, keepdims=True)).astype(np.float16),
        colors=rng.integers(0, 256, (count, 3)).astype(np.uint8),
        levels=block_levels.astype(np.uint8),
    )


@pytest.fixture
def mixed() -> Occupancy:
    """A block, one that is cut into eight, and one of these into eight again; at negative indices, too."""
    cut = levels.subdivide_keys(np.array([(-1, 0, 2)]))
    cut_again = levels.subdivide_keys(cut[3:4])
    keys = np.concatenate(([(0, 0, 0)], np.delete(cut, 3, axis=0), cut_again))
    return some_map(keys, np.array([0] + 7 * [1] + 8 * [2]))


def states(occupancy: Occupancy) -> dict[tuple[int, ...], int]:
    """State at every cell of the finest lattice."""
    found = {}
    for state in (FREE, OCCUPIED, UNKNOWN):
        for corner, edge in zip(occupancy.voxels(state), occupancy.edges(state), strict=True):
            for part in np.ndindex(edge, edge, edge):
                found[tuple(corner + part)] = state
    return found


def test_corners_edges_and_centers(mixed: Occupancy) -> None:
    assert mixed.finest == 0.02
    assert len(states(mixed)) == 2 * (4 * 8) ** 3  # two blocks of level 0, nothing twice
    corners, edges = mixed.occupied_voxels(), mixed.occupied_edges()
    assert set(np.unique(edges)) == {1, 2, 4}
    assert not (corners % edges[:, None]).any()
    centers = mixed.centers(corners, edges)
    np.testing.assert_allclose(centers - mixed.origin, (corners + 0.5 * edges[:, None]) * 0.02)


def test_cut_to_the_finest_every_part_says_what_the_whole_says(mixed: Occupancy) -> None:
    fine = levels.make_uniform(mixed, 2)
    assert fine.voxel_size == 0.02
    assert not fine.deepest
    assert states(fine) == states(mixed)
    wanted = dict(zip(map(tuple, mixed.occupied_voxels().tolist()), mixed.colors.tolist(), strict=True))
    found = dict(zip(map(tuple, fine.occupied_voxels().tolist()), fine.colors.tolist(), strict=True))
    assert all(found[corner] == color for corner, color in wanted.items())


@pytest.mark.parametrize("level", [0, 1])
def test_put_together_occupied_wins_over_unknown_over_free(mixed: Occupancy, level: int) -> None:
    made = levels.make_uniform(mixed, level)
    edge = 4 >> level
    parts: dict[tuple[int, ...], list[int]] = {}
    for cell, state in states(mixed).items():
        parts.setdefault(tuple(np.floor_divide(cell, edge).tolist()), []).append(state)
    wanted = {cell: OCCUPIED if OCCUPIED in own else UNKNOWN if UNKNOWN in own else FREE for cell, own in parts.items()}
    assert states(made) == wanted
    np.testing.assert_allclose(np.linalg.norm(made.features.astype(float), axis=1), 1, atol=2e-3)


def test_colors_of_parts_are_averaged() -> None:
    keys = levels.subdivide_keys(np.array([(0, 0, 0)]))
    parts = some_map(keys, np.ones(8))
    state = np.full((8, 512), FREE, np.uint8)
    state[0, [0, 1]] = OCCUPIED  # both in voxel (0, 0, 0) of the whole
    colors = np.array([(10, 20, 30), (30, 40, 50)], np.uint8)
    made = levels.make_uniform(parts.replace(state=state, colors=colors, features=np.eye(2, dtype=np.float16)), 0)
    np.testing.assert_array_equal(made.occupied_voxels(), [(0, 0, 0)])
    np.testing.assert_array_equal(made.colors, [(20, 30, 40)])
    np.testing.assert_allclose(made.features, [(0.5**0.5, 0.5**0.5)], atol=1e-3)


def test_a_map_of_one_size_stays_what_it_is() -> None:
    one = some_map(np.array([(0, 0, 0), (3, -1, 2)]), np.zeros(2))
    assert levels.make_uniform(one, 0).replace(levels=one.levels).state is one.state


@pytest.mark.parametrize("evidence", ["probability", "free", "hits"])
def test_a_block_is_known_if_a_single_voxel_has_any_evidence(evidence: str) -> None:
    one = some_map(np.array([(0, 0, 0), (3, -1, 2), (4, 0, 0)]), np.zeros(3))
    nothing = {name: np.zeros_like(getattr(one, name)) for name in ("probability", "free", "hits")}
    nothing[evidence][1, 77] = 1
    known = levels.mask_known_blocks(one.replace(**nothing))
    np.testing.assert_array_equal(known, (False, True, False))
    kept = levels.select_blocks(one, known)
    np.testing.assert_array_equal(kept.keys, [(3, -1, 2)])
    np.testing.assert_array_equal(kept.state, one.state[1:2])
    before, own = (np.count_nonzero(one.state[rows] == OCCUPIED) for rows in (slice(0, 1), slice(1, 2)))
    np.testing.assert_array_equal(kept.colors, one.colors[before : before + own])
    np.testing.assert_array_equal(kept.features, one.features[before : before + own])


def test_levels_are_put_together_in_their_order() -> None:
    whole = some_map(np.array([(0, 0, 0)]), np.zeros(1))
    half = some_map(levels.subdivide_keys(np.array([(1, 0, 0)])), np.zeros(8), seed=1)
    made = levels.combine_levels((whole, half))
    np.testing.assert_array_equal(made.levels, [0] + 8 * [1])
    assert made.voxel_size == whole.voxel_size
    for level, part in enumerate((whole, half)):
        again = levels.select_blocks(made, made.levels == level)
        for name in ("keys", "probability", "free", "hits", "state", "features", "colors"):
            np.testing.assert_array_equal(getattr(again, name), getattr(part, name))


@pytest.mark.parametrize("missing", [False, True])
def test_parts_give_the_highest_probability_the_most_evidence_and_the_mean_feature(missing: bool) -> None:
    keys = levels.subdivide_keys(np.array([(-2, 0, 1)]))
    parts = some_map(keys, np.ones(8), seed=2)
    if missing:
        parts = levels.select_blocks(parts, np.arange(8) != 5)
    made = levels.make_uniform(parts, 0)
    assert made.voxel_size == 0.08
    found = {name: cells(made, getattr(made, name)) for name in ("probability", "free", "hits")}
    for name, whole in found.items():
        wanted: dict[tuple[int, ...], float] = {}
        for at, value in cells(parts, getattr(parts, name)).items():
            over = tuple(np.floor_divide(at, 2).tolist())
            wanted[over] = max(wanted.get(over, 0), value)
        assert {at: value for at, value in whole.items() if at in wanted} == wanted
        assert not any(value for at, value in whole.items() if at not in wanted)
    sums: dict[tuple[int, ...], np.ndarray] = {}
    for at, feature in zip(map(tuple, (parts.occupied_voxels() // 2).tolist()), parts.features, strict=True):
        sums[at] = sums.get(at, np.zeros(3)) + feature.astype(float)
    for at, feature in zip(map(tuple, made.occupied_voxels().tolist()), made.features, strict=True):
        np.testing.assert_allclose(feature, sums[at] / np.linalg.norm(sums[at]), atol=2e-3)


def cells(occupancy: Occupancy, values: np.ndarray) -> dict[tuple[int, ...], float]:
    """Values of the voxels of a map of one size by their places."""
    local = np.stack(np.unravel_index(np.arange(512), (8, 8, 8)), axis=1)
    places = (occupancy.keys[:, None] * 8 + local).reshape(-1, 3)
    return dict(zip(map(tuple, places.tolist()), values.reshape(-1).tolist(), strict=True))
