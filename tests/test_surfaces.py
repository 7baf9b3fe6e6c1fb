"""Planes found in points of which many lie on none."""

import numpy as np

from freeocc3d.tracking.stereo.surfaces import find_planes


def _points(normal, count, rng, sigma):
    rays = np.concatenate((rng.uniform(-0.6, 0.6, (count, 2)), np.ones((count, 1))), axis=1)
    return rays / (rays @ normal)[:, None] + sigma * rng.normal(size=(count, 3))


def test_two_planes_among_clutter() -> None:
    rng, sigma = np.random.default_rng(3), 0.005
    wall, floor = np.array((0.1, 0.0, 0.4)), np.array((0.0, 0.6, 0.3))
    clutter = rng.uniform((-1, -1, 1), (1, 1, 4), (600, 3))
    points = np.concatenate((_points(wall, 1500, rng, sigma), _points(floor, 800, rng, sigma), clutter))
    planes = find_planes(points, np.full(len(points), sigma), most=2, least_share=0.1)
    assert len(planes) == 2
    for plane, truth in zip(planes, (wall, floor), strict=True):
        assert np.linalg.norm(plane.normal - truth) < 0.01 * np.linalg.norm(truth)
        off = plane.normal - truth
        assert off @ np.linalg.solve(plane.covariance, off) < 16.0


def test_no_plane_in_clutter() -> None:
    points = np.random.default_rng(0).uniform((-1, -1, 1), (1, 1, 4), (2000, 3))
    assert find_planes(points, np.full(2000, 0.005), most=5, least_share=0.1) == []


def test_too_few_points_are_no_plane() -> None:
    assert find_planes(np.zeros((0, 3)), np.zeros(0), most=5, least_share=0.01) == []
