"""Partner views, chosen by shared points and by angle."""

import numpy as np

from freeocc3d.depth.view_selection import APART, select_partners


def _line(positions):
    T = np.tile(np.eye(4), (len(positions), 1, 1))
    T[:, 0, 3] = positions
    return T


def test_a_few_degrees_apart_are_preferred() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform((-0.5, -0.5, 1.9), (0.5, 0.5, 2.1), (200, 3)).astype(np.float32)
    T = _line([0.0, 0.01, 0.28, 0.3, 1.8])  # 0, 0.3, 8, 8.5 and 42 degrees at 2 m
    seen_frame = np.repeat(np.arange(5), 200).astype(np.int32)
    seen_point = np.tile(np.arange(200), 5).astype(np.int32)
    chosen = select_partners(T, points, seen_frame, seen_point, count=2)
    assert set(chosen.partners[0].tolist()) == {2, 3}
    assert 1.2 < chosen.near[0] < 1.9
    assert 2.1 < chosen.far[0] < 4.0


def test_views_apart_are_under_wider_angles() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform((-0.5, -0.5, 1.9), (0.5, 0.5, 2.1), (200, 3)).astype(np.float32)
    T = _line([0.0, 0.25, 0.3, 0.5, 0.55])  # 7, 8.5, 14 and 15 degrees
    seen_frame = np.repeat(np.arange(5), 200).astype(np.int32)
    seen_point = np.tile(np.arange(200), 5).astype(np.int32)
    assert set(select_partners(T, points, seen_frame, seen_point, 2).partners[0].tolist()) == {1, 2}
    assert set(select_partners(T, points, seen_frame, seen_point, 2, APART).partners[0].tolist()) == {3, 4}


def test_frames_that_share_nothing_or_have_no_pose_are_no_partners() -> None:
    points = np.random.default_rng(0).uniform((-1, -1, 1), (1, 1, 3), (100, 3)).astype(np.float32)
    T = _line([0.0, 0.2, 0.3, 0.4])
    T[3] = np.nan
    seen_frame = np.repeat([0, 1, 2, 3], [50, 50, 50, 50]).astype(np.int32)
    seen_point = np.concatenate((np.arange(50), np.arange(50), np.arange(50, 100), np.arange(50))).astype(np.int32)
    chosen = select_partners(T, points, seen_frame, seen_point, count=4)
    assert [partners.tolist() for partners in chosen.partners] == [[1], [0], [], []]


def test_no_points_no_partners() -> None:
    none = np.zeros(0, np.int32)
    chosen = select_partners(_line([0.0, 1.0]), np.zeros((0, 3), np.float32), none, none, count=4)
    assert [len(partners) for partners in chosen.partners] == [0, 0]
