"""Splats are sorted and listed as in NumPy."""

import numpy as np

from freeocc3d.gaussians.tile_compositing import TILE, list_by_tile, sort_nearest_first


def test_splats_are_sorted_by_depth_and_ties_stay() -> None:
    z = np.random.default_rng(0).choice(np.linspace(0.02, 9, 40), 500).astype(np.float32)
    found = sort_nearest_first(np.arange(500), z.view(np.uint32))
    np.testing.assert_array_equal(found, np.argsort(z, kind="stable"))


def test_a_tile_lists_the_splats_whose_box_reaches_it() -> None:
    rng = np.random.default_rng(1)
    first = rng.integers(0, (5 * TILE, 3 * TILE), (60, 2))
    last = np.minimum(first + rng.integers(0, 2 * TILE, (60, 2)), (5 * TILE - 1, 3 * TILE - 1))
    box = np.stack((first[:, 0], last[:, 0], first[:, 1], last[:, 1]), axis=1).astype(np.int32)
    start, listed, first, places = list_by_tile(box, 5, 3)
    for tile in range(15):
        row, column = divmod(tile, 5)
        reached = (box[:, :2] // TILE - column, box[:, 2:] // TILE - row)
        inside = np.logical_and.reduce([(r[:, 0] <= 0) & (r[:, 1] >= 0) for r in reached])
        np.testing.assert_array_equal(listed[start[tile] : start[tile + 1]], np.flatnonzero(inside))
    for splat in range(60):
        own = places[first[splat] : first[splat + 1]]
        assert (listed[own] == splat).all()
        assert (np.diff(own) > 0).all()
    assert len(places) == first[-1] == start[-1]
