"""Trajectories against the truth: the matching of poses, and their alignment."""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from small_captures import pose_matrix, write_seven_scenes

from freeocc3d.capture import associate, open_capture
from freeocc3d.core.errors import FreeOccError
from freeocc3d.core.transforms import quats_to_rotations
from freeocc3d.core.tum_files import write_tum
from freeocc3d.core.types import Trajectory
from freeocc3d.tracking.trajectory_alignment import (
    Poses,
    TrajectoryAlignment,
    align_trajectories,
    read_poses,
    read_true_poses,
    select_estimated_poses,
)


def poses(T_world_cam: NDArray[np.float64]) -> Poses:
    return Poses(np.arange(len(T_world_cam), dtype=np.float64), T_world_cam)


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
    found = align_trajectories(poses(estimated), poses(true), "sim3")
    assert found.scale == pytest.approx(2.0)
    np.testing.assert_allclose(found.rotation, T_other_true[:3, :3].T, atol=1e-9)
    np.testing.assert_allclose(found.to_true(estimated[:, :3, 3]), true[:, :3, 3], atol=1e-9)
    np.testing.assert_allclose(found.to_estimate(true[:, :3, 3]), estimated[:, :3, 3], atol=1e-9)
    np.testing.assert_allclose(found.poses(estimated), true, atol=1e-9)


def test_without_scale_a_wrong_scale_stays_an_error() -> None:
    true = random_poses(40, seed=0)
    estimated = true.copy()
    estimated[:, :3, 3] *= 0.9
    found = align_trajectories(poses(estimated), poses(true))
    assert found.scale == 1.0
    spread = np.sqrt(((true[:, :3, 3] - true[:, :3, 3].mean(axis=0)) ** 2).sum(axis=1).mean())
    left = np.linalg.norm(found.to_true(estimated[:, :3, 3]) - true[:, :3, 3], axis=1)
    assert np.sqrt((left**2).mean()) == pytest.approx(0.1 * spread)


def test_none_leaves_the_worlds_as_they_are() -> None:
    found = align_trajectories(poses(random_poses(5, seed=0)), poses(random_poses(5, seed=1)), "none")
    np.testing.assert_array_equal(found.to_true(np.eye(3)), np.eye(3))
    with pytest.raises(FreeOccError, match="se3, sim3, none"):
        align_trajectories(poses(random_poses(5, seed=0)), poses(random_poses(5, seed=1)), "sim2")


def test_poses_belong_together_by_time() -> None:
    a, b = np.array([0.0, 0.1, 0.2, 0.3, 0.9]), np.array([0.101, 0.195, 0.5])
    rows_a, rows_b = associate(a, b)
    assert rows_a.tolist() == [1, 2]
    assert rows_b.tolist() == [0, 1]
    rows_b, rows_a = associate(b, a)
    assert (rows_a.tolist(), rows_b.tolist()) == ([1, 2], [0, 1])
    for empty in (associate(np.zeros(0), b), associate(a, np.zeros(0)), associate(a, b + 100)):
        assert len(empty[0]) == len(empty[1]) == 0


def test_only_frames_with_a_pose_in_both_count() -> None:
    true, estimated = random_poses(10, seed=2), random_poses(10, seed=2)
    estimated[0, :3, 3] += 100.0
    found = align_trajectories(Poses(np.arange(10.0)[:-1], estimated[:-1]), Poses(np.arange(10.0)[1:], true[1:]))
    np.testing.assert_allclose(found.rotation, np.eye(3), atol=1e-9)
    np.testing.assert_allclose(found.translation, 0, atol=1e-9)


def test_too_few_matching_frames_are_refused() -> None:
    with pytest.raises(FreeOccError, match="at least 3"):
        align_trajectories(poses(random_poses(5, seed=3)), poses(random_poses(2, seed=3)))


@pytest.mark.parametrize("jitter_m", [0.0, 0.001])
def test_a_camera_that_moved_along_a_line_is_refused(jitter_m: float) -> None:
    line = np.tile(np.eye(4), (10, 1, 1))
    line[:, 0, 3] = 0.3 * np.arange(10)
    line[:, :3, 3] += np.random.default_rng(0).normal(0, jitter_m, (10, 3))
    with pytest.raises(FreeOccError, match="line"):
        align_trajectories(poses(line), poses(random_poses(10, seed=0)))
    with pytest.raises(FreeOccError, match="line"):
        align_trajectories(poses(random_poses(10, seed=0)), poses(line))


def test_inputs_are_left_as_they_are() -> None:
    true, estimated = random_poses(6, seed=4), random_poses(6, seed=5)
    copies = true.copy(), estimated.copy()
    align_trajectories(poses(estimated), poses(true), "sim3").poses(estimated)
    np.testing.assert_array_equal(true, copies[0])
    np.testing.assert_array_equal(estimated, copies[1])


def test_true_poses_are_the_captures(tmp_path: Path) -> None:
    folder = write_seven_scenes(tmp_path / "scan", 4)
    (folder / "frame-000002.pose.txt").unlink()
    found = read_true_poses(open_capture(folder))
    assert found.timestamps.tolist() == [0.0, 1.0, 3.0]
    np.testing.assert_allclose(found.T_world_cam[2], pose_matrix(3), atol=1e-6)
    np.testing.assert_allclose(read_poses(folder).T_world_cam, found.T_world_cam)


def test_a_capture_without_poses_is_refused(tmp_path: Path) -> None:
    with pytest.raises(FreeOccError, match="no poses"):
        read_true_poses(open_capture(write_seven_scenes(tmp_path / "scan", 3, poses=False)))


def test_frames_without_a_pose_are_left_out() -> None:
    T = random_poses(4, seed=0)
    T[1] = np.nan
    trajectory = Trajectory(np.arange(4.0), T, np.zeros(0, np.int32), np.full(4, "tracked"), np.ones(4, np.float32))
    assert select_estimated_poses(trajectory).timestamps.tolist() == [0.0, 2.0, 3.0]


@pytest.mark.parametrize("columns", [8, 12, 16])
def test_pose_files_are_read_in_their_usual_forms(tmp_path: Path, columns: int) -> None:
    T, path = random_poses(5, seed=0), tmp_path / "poses.txt"
    if columns == 8:
        status = np.full(5, "tracked")
        write_tum(path, Trajectory(np.arange(5.0), T, np.zeros(0, np.int32), status, np.ones(5, np.float32)))
    else:
        np.savetxt(path, T.reshape(5, 16)[:, :columns], header="poses")
    found = read_poses(path)
    np.testing.assert_allclose(found.T_world_cam, T, atol=1e-7)
    np.testing.assert_array_equal(found.timestamps, np.arange(5.0))


@pytest.mark.parametrize("text", ["", "# nothing\n", "1 2 3\n", "a b c d e f g h\n", "2 " * 16, "1 2\n" * 3 + "1\n"])
def test_files_that_are_no_trajectory_are_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "poses.txt").write_text(text)
    with pytest.raises(FreeOccError, match=r"not a (trajectory|rigid)|holds a matrix"):
        read_poses(tmp_path / "poses.txt")
    with pytest.raises(FreeOccError, match="no file or capture"):
        read_poses(tmp_path / "absent.txt")


def test_the_json_form_is_plain() -> None:
    assert TrajectoryAlignment.identity().as_dict() == {
        "scale": 1.0, "rotation": np.eye(3).tolist(), "translation": [0.0, 0.0, 0.0]
    }  # fmt: skip
