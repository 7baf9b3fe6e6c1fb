"""The upward direction of a scan whose cameras pitch."""

import numpy as np

from freeocc3d.capture.synthetic import camera_on_the_walk
from freeocc3d.gaussians.upright import estimate_up
from freeocc3d.geometry import quats_to_rotations


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
