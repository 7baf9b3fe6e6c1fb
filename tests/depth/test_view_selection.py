"""Partner views, chosen by shared points and by angle."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from freeocc3d.depth.view_selection import ALIKE, APART, select_partners


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


def plainly(T, points, seen_frame, seen_point, angles) -> tuple[np.ndarray, np.ndarray]:
    """(N, N) scores of the frames as partners of each other, and (N, 2) depth ranges."""
    sees = [set(seen_point[seen_frame == n].tolist()) for n in range(len(T))]
    scores, ranges = np.zeros((len(T), len(T))), np.zeros((len(T), 2))
    for n, pose in enumerate(T):
        depths = [(points[p] - pose[:3, 3]) @ pose[:3, 2] for p in sees[n]]
        ranges[n] = np.percentile([depth for depth in depths if depth > 0], (2, 98)) * (0.7, 1.6)
        for m, other in enumerate(T):
            for p in sees[n] & sees[m] if n != m else ():
                a, b = points[p] - pose[:3, 3], points[p] - other[:3, 3]
                if a @ pose[:3, 2] <= 0:
                    continue
                near, far = sorted((np.linalg.norm(a), np.linalg.norm(b)))
                angle = np.degrees(np.arccos(a @ b / (near * far)))
                width = angles.below if angle < angles.best else angles.above
                scores[n, m] += np.exp(-0.5 * ((angle - angles.best) / width) ** 2) * near / far
    return scores, ranges


@pytest.mark.parametrize("angles", [ALIKE, APART])
def test_partners_and_ranges_are_those_of_the_definition(angles) -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform((-1.5, -1, 0.5), (1.5, 1, 3), (150, 3))
    T = np.tile(np.eye(4), (9, 1, 1))
    T[:, :3, :3] = Rotation.from_rotvec(rng.normal(0, 0.25, (9, 3))).as_matrix()
    T[:, :3, 3] = rng.uniform((-0.6, -0.2, -0.5), (0.6, 0.2, 0.8), (9, 3))
    seen = np.argwhere(rng.random((9, 150)) < 0.6)
    rng.shuffle(seen)
    seen_frame, seen_point = seen.T.astype(np.int32)
    scores, ranges = plainly(T, points, seen_frame, seen_point, angles)
    chosen = select_partners(T, np.float32(points), seen_frame, seen_point, 4, angles)
    for n, partners in enumerate(chosen.partners):
        order = np.argsort(-scores[n], kind="stable")[:4]
        assert partners.tolist() == [m for m in order.tolist() if scores[n, m] >= 3.0]
    np.testing.assert_allclose(np.stack((chosen.near, chosen.far), axis=1), ranges, rtol=1e-5)
    assert 0 < min(len(partners) for partners in chosen.partners) <= 4


@pytest.mark.parametrize(("count", "own"), [(19, False), (20, True)])
def test_a_range_of_a_frames_own_takes_twenty_points(count: int, own: bool) -> None:
    rng = np.random.default_rng(0)
    points = np.concatenate(
        (rng.uniform((-1, -1, 1), (1, 1, 2), (200, 3)), rng.uniform((-1, -1, 8), (1, 1, 9), (20, 3)))
    )
    seen_point = np.concatenate((np.arange(200), 200 + np.arange(count))).astype(np.int32)
    seen_frame = np.repeat((0, 1), (200, count)).astype(np.int32)
    chosen = select_partners(_line([0.0, 0.2]), np.float32(points), seen_frame, seen_point, 1)
    assert (chosen.near[1] > 5.5) == own
    if not own:
        every = np.percentile(points[seen_point, 2], (2, 98)) * (0.7, 1.6)
        np.testing.assert_allclose((chosen.near[1], chosen.far[1]), every, rtol=1e-5)
