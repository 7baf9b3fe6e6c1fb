"""The upward direction of a scan whose cameras pitch."""

import numpy as np

from freeocc3d.capture.readers.synthetic import camera_on_the_walk
from freeocc3d.core.transforms import quats_to_rotations
from freeocc3d.tracking.upright.up_direction import estimate_up, turn_back


def turned(seed: int) -> np.ndarray:
    quat = np.random.default_rng(seed).normal(size=4)
    return quats_to_rotations(quat / np.linalg.norm(quat))


def test_up_is_found_in_any_frame_though_cameras_look_down() -> None:
    T = np.stack([camera_on_the_walk(phase) for phase in np.linspace(0, 1, 40)])
    rng = np.random.default_rng(0)
    floor = np.c_[rng.uniform(-2, 2, (3000, 2)), rng.normal(0, 0.01, 3000)]
    wall = np.c_[rng.uniform(-2, 2, 3000), np.full(3000, 2.0), rng.uniform(0, 2.5, 3000)]
    for seed in range(3):
        R = turned(seed)
        moved = T.copy()
        moved[:, :3] = R @ T[:, :3]
        up = estimate_up(moved, np.concatenate((floor, wall)) @ R.T)
        assert np.degrees(np.arccos(up @ R[:, 2])) < 1.5


def test_one_camera_and_no_points_give_the_cameras_up() -> None:
    up = estimate_up(np.eye(4)[None], np.zeros((0, 3)))
    np.testing.assert_allclose(up, (0, -1, 0), atol=1e-6)
    assert np.linalg.norm(estimate_up(np.zeros((0, 4, 4)), np.zeros((0, 3)))) == 1


def rolled(T: np.ndarray, degrees: np.ndarray) -> np.ndarray:
    """Cameras turned about where they look."""
    out = T.copy()
    cos, sin = np.cos(np.deg2rad(degrees))[:, None], np.sin(np.deg2rad(degrees))[:, None]
    out[:, :3, 0] = cos * T[:, :3, 0] + sin * T[:, :3, 1]
    out[:, :3, 1] = cos * T[:, :3, 1] - sin * T[:, :3, 0]
    return out


def test_cameras_that_are_rolled_or_held_sideways_have_the_same_up() -> None:
    T = np.stack([camera_on_the_walk(phase) for phase in np.linspace(0, 1, 40)])
    rng = np.random.default_rng(0)
    floor = np.c_[rng.uniform(-2, 2, (3000, 2)), rng.normal(0, 0.01, 3000)]
    wall = np.c_[rng.uniform(-2, 2, 3000), np.full(3000, 2.0), rng.uniform(0, 2.5, 3000)]
    points = np.concatenate((floor, wall))
    for roll in (0.0, 20.0, -20.0, 90.0, -90.0):
        held = rolled(T, roll + rng.normal(0, 6, len(T)))
        for scale in (0.4, 1.0, 4.0):  # units that are no meters
            held[:, :3, 3] = scale * T[:, :3, 3]
            assert estimate_up(held, scale * points)[2] > np.cos(np.deg2rad(1.5)), (roll, scale)


def test_images_that_were_turned_to_one_size_do_not_turn_up() -> None:
    T = np.stack([camera_on_the_walk(phase) for phase in np.linspace(0, 0.1, 20)])  # they look about the same way
    quarters = np.where(np.arange(20) % 5 < 2, 1, 0) * np.where(np.arange(20) % 2, 1, -1)
    # What a picture shows above lies on its left once it is turned counter-clockwise.
    given = rolled(T, 90.0 * quarters)
    turned_left = int(np.flatnonzero(quarters == 1)[0])
    np.testing.assert_allclose(-given[turned_left, :3, 0], -T[turned_left, :3, 1], atol=1e-12)
    np.testing.assert_allclose(turn_back(given, quarters), T, atol=1e-12)
    points = np.zeros((0, 3))
    assert estimate_up(turn_back(given, quarters), points) @ estimate_up(T, points) > 1 - 1e-12
    assert estimate_up(given, points) @ estimate_up(T, points) < 0.99, "what the turned images alone would say"


def test_a_camera_that_nods_is_not_held_sideways() -> None:
    T = np.tile(np.eye(4), (60, 1, 1))
    for pose, pitch in zip(T, np.linspace(-np.pi / 2, np.pi / 2, 60), strict=True):
        pose[1:3, 1:3] = [[np.cos(pitch), -np.sin(pitch)], [np.sin(pitch), np.cos(pitch)]]
    assert -estimate_up(T, np.zeros((0, 3)))[1] > 0.99


def test_up_follows_level_surfaces_by_ten_degrees_and_two_corrections_at_most() -> None:
    yaw = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    T = np.tile(np.eye(4), (12, 1, 1))
    T[:, 0, 0] = T[:, 2, 2] = np.cos(yaw)
    T[:, 0, 2], T[:, 2, 0] = np.sin(yaw), -np.sin(yaw)
    flat = np.random.default_rng(0).uniform(-3, 3, (4000, 2))
    for azimuth in np.deg2rad(np.arange(0, 360, 30)):
        for tilt, found in ((9.0, True), (18.0, False)):
            away = np.array((np.cos(azimuth), 0.0, np.sin(azimuth)))
            normal = np.cos(np.deg2rad(tilt)) * np.array((0.0, -1.0, 0.0)) + np.sin(np.deg2rad(tilt)) * away
            a = np.cross(normal, (0.3, 0.4, 0.8))
            a /= np.linalg.norm(a)
            points = flat @ np.stack((a, np.cross(normal, a)))
            up = estimate_up(T, points)
            if found:
                assert np.degrees(np.arccos(min(up @ normal, 1.0))) < 1.0
            else:
                assert np.degrees(np.arccos(-up[1])) <= 10.0 + 3.0 + 0.8 + 0.1
