"""Trajectories against the truth: the alignment that is found, and the error that remains."""

from pathlib import Path

import numpy as np
import pytest
from helpers import pose_matrix, write_seven_scenes
from numpy.typing import NDArray

from freeocc3d.capture import open_capture
from freeocc3d.errors import FreeOccError
from freeocc3d.evaluation.align import align_trajectory, ate_rmse, true_poses
from freeocc3d.geometry import quats_to_rotations
from freeocc3d.types import Trajectory


def trajectory(T_world_cam: NDArray[np.float64]) -> Trajectory:
    n = len(T_world_cam)
    return Trajectory(
        np.arange(n, dtype=np.float64),
        T_world_cam,
        np.zeros(0, np.int32),
        np.full(n, "tracked"),
        np.ones(n, np.float32),
    )


def random_poses(n: int, seed: int) -> NDArray[np.float64]:
    """(n, 4, 4) camera-to-world."""
    rng = np.random.default_rng(seed)
    quats = rng.normal(size=(n, 4))
    T = np.tile(np.eye(4), (n, 1, 1))
    T[:, :3, :3] = quats_to_rotations(quats / np.linalg.norm(quats, axis=1, keepdims=True))
    T[:, :3, 3] = rng.uniform(-2, 2, (n, 3))
    return T


def test_alignment_recovers_the_similarity_between_two_worlds() -> None:
    true = random_poses(40, seed=0)
    T_other_true = random_poses(1, seed=1)[0]
    estimated = T_other_true @ true
    estimated[:, :3, 3] *= 0.5
    found = align_trajectory(trajectory(estimated), true, with_scale=True)
    assert found.scale == pytest.approx(2.0)
    np.testing.assert_allclose(found.rotation, T_other_true[:3, :3].T, atol=1e-9)
    np.testing.assert_allclose(found.to_true(estimated[:, :3, 3]), true[:, :3, 3], atol=1e-9)
    np.testing.assert_allclose(found.to_estimate(true[:, :3, 3]), estimated[:, :3, 3], atol=1e-9)
    assert found.ate_rmse_m == pytest.approx(0.0, abs=1e-9)
    assert found.frames_matched == 40


def test_without_scale_a_wrong_scale_stays_an_error() -> None:
    true = random_poses(40, seed=0)
    estimated = true.copy()
    estimated[:, :3, 3] *= 0.9
    found = align_trajectory(trajectory(estimated), true, with_scale=False)
    assert found.scale == 1.0
    spread = np.sqrt(((true[:, :3, 3] - true[:, :3, 3].mean(axis=0)) ** 2).sum(axis=1).mean())
    assert found.ate_rmse_m == pytest.approx(0.1 * spread)


def test_ate_is_the_root_mean_square_of_what_alignment_leaves() -> None:
    square = np.array([[1.0, 1, 0], [1, -1, 0], [-1, -1, 0], [-1, 1, 0]])
    true, estimated = np.tile(np.eye(4), (4, 1, 1)), np.tile(np.eye(4), (4, 1, 1))
    true[:, :3, 3] = square
    estimated[:, :3, 3] = square + np.array([0, 0, 0.03]) * np.array([[1], [-1], [1], [-1]])
    # Corners lifted and lowered in turn: no rigid motion makes that better.
    assert ate_rmse(trajectory(estimated), true) == pytest.approx(0.03, rel=1e-3)


def test_only_frames_with_a_pose_in_both_count() -> None:
    true = random_poses(10, seed=2)
    estimated = true.copy()
    estimated[0, :3, 3] += 100.0
    true[0] = np.nan
    estimated[1] = np.nan
    found = align_trajectory(trajectory(estimated), true)
    assert found.frames_matched == 8
    assert found.ate_rmse_m == pytest.approx(0.0, abs=1e-9)


def test_too_few_matching_frames_are_refused() -> None:
    true = random_poses(5, seed=3)
    true[2:] = np.nan
    with pytest.raises(FreeOccError, match="at least 3"):
        align_trajectory(trajectory(random_poses(5, seed=3)), true)


def test_a_camera_that_moved_along_a_line_is_refused() -> None:
    line = np.tile(np.eye(4), (10, 1, 1))
    line[:, 0, 3] = np.arange(10)
    with pytest.raises(FreeOccError, match="line"):
        align_trajectory(trajectory(line), line)


def test_poses_of_another_capture_are_refused() -> None:
    with pytest.raises(FreeOccError, match="same capture"):
        align_trajectory(trajectory(random_poses(5, seed=0)), random_poses(6, seed=0))


def test_inputs_are_left_as_they_are() -> None:
    true, estimated = random_poses(6, seed=4), random_poses(6, seed=5)
    copies = true.copy(), estimated.copy()
    align_trajectory(trajectory(estimated), true, with_scale=True)
    np.testing.assert_array_equal(true, copies[0])
    np.testing.assert_array_equal(estimated, copies[1])


def test_true_poses_are_the_captures(tmp_path: Path) -> None:
    folder = write_seven_scenes(tmp_path / "scan", 4)
    (folder / "frame-000002.pose.txt").unlink()
    poses = true_poses(open_capture(folder))
    np.testing.assert_allclose(poses[3], pose_matrix(3), atol=1e-6)
    assert np.isnan(poses[2]).all()


def test_a_capture_without_poses_is_refused(tmp_path: Path) -> None:
    with pytest.raises(FreeOccError, match="no poses"):
        true_poses(open_capture(write_seven_scenes(tmp_path / "scan", 3, poses=False)))
