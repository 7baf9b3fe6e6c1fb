"""Where rays of two cameras meet, and which frames are paired."""

from __future__ import annotations

import numpy as np
import pytest

from freeocc3d.depth import sparse_points


def toward(centers: np.ndarray, points: np.ndarray) -> np.ndarray:
    ways = points - centers
    return ways / np.linalg.norm(ways, axis=1, keepdims=True)


def test_rays_meet_where_they_were_aimed_at() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform((-1, -1, 2), (1, 1, 5), (50, 3))
    a, b = np.array((-0.4, 0.1, 0.2)), np.array((0.5, -0.2, -0.1))
    np.testing.assert_allclose(sparse_points._meeting(a, toward(a, points), b, toward(b, points)), points, atol=1e-9)
    behind = sparse_points._meeting(a, -toward(a, points), b, toward(b, points))
    assert len(behind) == 0
    assert len(sparse_points._meeting(a, toward(a, points), b, -toward(b, points))) == 0


@pytest.mark.parametrize(("degrees", "kept"), [(1.9, False), (2.1, True)])
def test_rays_must_meet_under_two_degrees(degrees: float, kept: bool) -> None:
    point = np.array([(0.0, 0.0, 3.0)])
    b = np.array((3 * np.tan(np.deg2rad(degrees)), 0.0, 0.0))
    assert len(sparse_points._meeting(np.zeros(3), toward(np.zeros(3), point), b, toward(b, point))) == kept


@pytest.mark.parametrize(("gap_m", "kept"), [(0.0078, True), (0.0082, False)])
@pytest.mark.parametrize("farther", [0, 1])
def test_rays_may_miss_each_other_by_a_part_of_the_shorter_way(gap_m: float, kept: bool, farther: int) -> None:
    """Two rays that cross at right angles, one 2 m and one 4 m away; they miss each other along the third axis."""
    lengths = (4.0, 2.0) if farther == 0 else (2.0, 4.0)
    a, b = np.array((0.0, 0.0, -lengths[0])), np.array((-lengths[1], gap_m, 0.0))
    found = sparse_points._meeting(a, np.array([(0.0, 0.0, 1.0)]), b, np.array([(1.0, 0.0, 0.0)]))
    assert len(found) == kept
    if kept:
        np.testing.assert_allclose(found, [(0.0, gap_m / 2, 0.0)], atol=1e-12)


def turned(degrees: float, x: float) -> np.ndarray:
    T = np.eye(4)
    T[0, 0] = T[2, 2] = np.cos(np.deg2rad(degrees))
    T[0, 2], T[2, 0] = np.sin(np.deg2rad(degrees)), -np.sin(np.deg2rad(degrees))
    T[0, 3] = x
    return T


def test_frames_are_paired_with_the_next_ones() -> None:
    away = np.stack([turned(90.0 * n, 0.1 * n) for n in range(30)])  # neighbors look elsewhere
    frames = list(range(0, 60, 2))
    T = np.full((60, 4, 4), np.nan)
    T[frames] = away
    found = sparse_points._pairs(T, frames)
    assert found == sorted(set(found))
    ahead = {(2 * n, 2 * (n + step)) for n in range(30) for step in (1, 2, 3, 5, 8, 12) if n + step < 30}
    assert ahead <= set(found)
    for a, b in set(found) - ahead:
        assert (b - a) // 2 > 12
        assert (b - a) // 2 % 4 == 0, "they look the same way"


@pytest.mark.parametrize(("degrees", "paired"), [(36.0, True), (37.5, False)])
def test_frames_of_other_times_are_paired_if_they_look_the_same_way(degrees: float, paired: bool) -> None:
    T = np.stack([turned(180.0, 0.0)] * 20)
    T[0], T[13], T[19] = turned(0.0, 0.0), turned(degrees, 0.0), turned(0.0, 5.0)
    found = sparse_points._pairs(T, list(range(20)))
    assert ((0, 13) in found) == paired
    assert (0, 19) in found


def test_of_many_frames_of_other_times_some_near_and_some_far_ones_are_taken() -> None:
    T = np.stack([turned(0.0, 10.0 * n) for n in range(60)])
    found = sparse_points._pairs(T, list(range(60)))
    assert {(0, b) for b in (13, 20, 27, 34, 41, 48)} <= set(found)  # of the 47 others, every seventh by its distance
    assert (0, 55) not in found
