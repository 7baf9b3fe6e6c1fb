"""The benchmark's disturbances of depth, and what it counts as in the air."""

import numpy as np
from benchmark import air, disturbed_depth
from scenes import CAMERA, posed, wall_frame


def looks_at_a_wall(count: int):
    """A camera that walks two meters toward a wall 4 m away."""
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, 2, 3] = np.linspace(0, 2, count)
    return posed([wall_frame(4.0 - z, n) for n, z in enumerate(poses[:, 2, 3])], poses), poses


def test_people_panes_and_mixed_edges_are_put_where_they_belong() -> None:
    looks, poses = looks_at_a_wall(40)
    walked = [look.frame.depth_m for look in disturbed_depth.disturb(looks, disturbed_depth.walk_ahead(poses))]
    changed = np.array([(depth != look.frame.depth_m).any() for depth, look in zip(walked, looks, strict=True)])
    assert set(np.flatnonzero(changed)) <= set(range(10, 20))
    assert changed.sum() == 10
    for n in np.flatnonzero(changed):  # the end of the way, less the radius
        assert abs(walked[n][60, 80] - (2.0 - poses[n, 2, 3] - 0.22)) < 0.05
    change, middles = disturbed_depth.make_panes(looks)
    np.testing.assert_allclose(middles, np.tile((0, 0, 4.0), (len(middles), 1)), atol=1e-6)
    for look, again in zip(looks, disturbed_depth.disturb(looks, change), strict=True):
        pane = again.frame.depth_m != look.frame.depth_m
        assert pane[60, 80] or again.frame.depth_m[60, 80] == 0
        assert 0.8 < (again.frame.depth_m[pane] == 0).mean() < 0.97
        assert (again.frame.depth_m[pane & (again.frame.depth_m > 0)] > look.frame.depth_m[60, 80]).all()
    frame = looks[0].frame
    frame.depth_m[:, :80] = 1.0
    mixed = disturbed_depth.mix_edges(0, looks[0], np.random.default_rng(0))
    between = (mixed > 1.0) & (mixed < 4.0)
    assert set(np.flatnonzero(between.any(axis=0))) == {79, 80}
    assert CAMERA.height * 0.7 < between.sum() < CAMERA.height * 1.3


def test_a_voxel_is_in_the_air_without_a_neighbor() -> None:
    ours, others = np.array([(0, 0, 0), (5, 5, 5), (9, 9, 9)]), np.array([(1, -1, 0), (9, 9, 9), (5, 5, 7)])
    assert air._beside(ours, others).tolist() == [True, False, True]


def test_who_has_left_is_counted_and_taken_away() -> None:
    looks, poses = looks_at_a_wall(40)
    clean, _ = air._map(looks, None, True)
    brought, left = (air._map(looks, disturbed_depth.stand_and_leave(poses), evidence)[0] for evidence in (False, True))
    brought, left = (found[~air._beside(found, clean)] for found in (brought, left))
    seen_again = range(-3, 4)  # rows of voxels that stay in view until the camera is there
    assert np.isin(brought[:, 1], seen_again).sum() > 20
    assert not np.isin(left[:, 1], seen_again).any()
    found = {"brought": 7, "left": 2, "lost": 0.01, "opened": 4}
    rows = [{"capture": "a", "disturbances": {"panes": found}}]
    assert air.tabulate_air(rows)[-1] == "| a | panes | 7 | 2 | 1.0% | 4 |"
