"""Errors of trajectories: hand-counted cases, and evo on the same files."""

from pathlib import Path

import numpy as np
import pytest
from evo.core import metrics, sync
from evo.tools import file_interface
from numpy.typing import NDArray

from freeocc3d.core.errors import FreeOccError
from freeocc3d.core.transforms import quats_to_rotations
from freeocc3d.core.tum_files import write_tum
from freeocc3d.core.types import Trajectory
from freeocc3d.evaluation.trajectory_errors import (
    describe_few_matches,
    measure_relative_error,
    measure_trajectory_errors,
    pair_by_path,
)
from freeocc3d.tracking.trajectory_alignment import Poses, TrajectoryAlignment, align_trajectories, read_poses


def walk(n: int, seed: int, rests: bool = False) -> NDArray[np.float64]:
    """(n, 4, 4) a hand-held walk: steps of some centimeters, the camera turning; it may stand still for a while."""
    rng = np.random.default_rng(seed)
    heading = np.cumsum(rng.normal(0, 0.1, n))
    step = np.stack((np.cos(heading), np.sin(heading), 0.1 * rng.normal(size=n)), axis=1) * rng.uniform(
        0.01, 0.06, (n, 1)
    )
    if rests:
        step[n // 3 : n // 2] = 0
    quats = np.cumsum(rng.normal(0, 0.05, (n, 4)), axis=0) + (1, 0, 0, 0)
    T = np.tile(np.eye(4), (n, 1, 1))
    T[:, :3, :3] = quats_to_rotations(quats / np.linalg.norm(quats, axis=1, keepdims=True))
    T[:, :3, 3] = np.cumsum(step, axis=0)
    return T


def disturbed(T: NDArray[np.float64], seed: int) -> NDArray[np.float64]:
    """An estimate of it: another world, drift and noise."""
    rng = np.random.default_rng(seed)
    out = T.copy()
    out[:, :3, 3] += np.cumsum(rng.normal(0, 0.002, (len(T), 3)), axis=0)
    turn = rng.normal(0, 0.01, (len(T), 4)) + (1, 0, 0, 0)
    out[:, :3, :3] = out[:, :3, :3] @ quats_to_rotations(turn / np.linalg.norm(turn, axis=1, keepdims=True))
    return walk(1, seed=seed + 1)[0] @ out


def write(path: Path, timestamps: NDArray[np.float64], T: NDArray[np.float64]) -> Path:
    n = len(T)
    write_tum(path, Trajectory(timestamps, T, np.zeros(0, np.int32), np.full(n, "tracked"), np.ones(n, np.float32)))
    return path


def test_ate_is_the_root_mean_square_of_what_alignment_leaves() -> None:
    true = np.tile(np.eye(4), (4, 1, 1))
    true[:, :3, 3] = [[1.0, 1, 0], [1, -1, 0], [-1, -1, 0], [-1, 1, 0]]
    estimated = true.copy()
    estimated[:, 2, 3] = 0.03, -0.03, 0.03, -0.03
    # Corners lifted and lowered in turn: no rigid motion makes that better.
    a, b = Poses(np.arange(4.0), estimated), Poses(np.arange(4.0), true)
    errors = measure_trajectory_errors(a, b, align_trajectories(a, b))
    assert errors.ate_rmse_m == pytest.approx(0.03, rel=1e-3)
    assert errors.as_dict()["ate_m"]["max"] == pytest.approx(0.03, rel=1e-3)


def test_a_mirrored_trajectory_keeps_its_error() -> None:
    """A world mirrored at x = 0 is no rigid motion away: of a cross in the plane x = ±a, y = ±b, z = ±c with a the
    smallest extent, the best a rotation can do leaves every center off by 2 a."""
    corners = np.array(np.meshgrid([-0.1, 0.1], [-1, 1], [-2, 2], indexing="ij"), float).reshape(3, -1).T
    corners[:, 0] *= np.sign(corners[:, 1] * corners[:, 2])  # chiral: not its own mirror image
    corners = np.unique(corners, axis=0)
    true = np.tile(np.eye(4), (len(corners), 1, 1))
    true[:, :3, 3] = corners
    mirrored = true.copy()
    mirrored[:, 0, 3] *= -1
    a, b = Poses(np.arange(len(true), dtype=float), mirrored), Poses(np.arange(len(true), dtype=float), true)
    assert measure_trajectory_errors(a, b, align_trajectories(a, b)).ate_rmse_m == pytest.approx(0.2)


def test_a_steady_drift_is_the_relative_error_over_its_distance() -> None:
    true = np.tile(np.eye(4), (51, 1, 1))
    true[:, 0, 3] = 0.02 * np.arange(51)
    estimated = true.copy()
    estimated[:, 0, 3] *= 1.05
    found = measure_relative_error(estimated, true, 0.5)
    assert found is not None
    assert found.rotation_rmse_deg == pytest.approx(0, abs=1e-6)
    # 26 frames have one 0.5 m ahead; for two more the last frame is within a tenth of that.
    apart = np.concatenate((np.full(26, 0.5), (0.48, 0.46)))
    assert found.pairs == len(apart)
    assert found.translation_rmse_m == pytest.approx(0.05 * np.sqrt((apart**2).mean()))
    assert measure_relative_error(estimated, true, 2.0) is None


def test_a_steady_turn_is_the_relative_rotation() -> None:
    true = np.tile(np.eye(4), (11, 1, 1))
    true[:, 0, 3] = 0.1 * np.arange(11)
    angle = np.deg2rad(2.0) * np.arange(11)
    estimated = true.copy()
    estimated[:, 0, 0] = estimated[:, 1, 1] = np.cos(angle)
    estimated[:, 1, 0], estimated[:, 0, 1] = np.sin(angle), -np.sin(angle)
    found = measure_relative_error(estimated, true, 0.5)
    assert found is not None
    assert found.rotation_rmse_deg == pytest.approx(10.0)


def test_the_pairs_are_those_of_a_plain_search() -> None:
    centers = walk(200, seed=3, rests=True)[:, :3, 3]
    path = np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(centers, axis=0), axis=1))))
    expected = []
    for i in range(len(path) - 1):
        off = np.abs(path[i + 1 :] - path[i] - 0.5)
        if off.min() <= 0.05:
            expected.append((i, i + 1 + int(np.argmin(off))))
    np.testing.assert_array_equal(np.stack(pair_by_path(centers, 0.5), axis=1), expected)


def test_the_order_of_frames_does_not_count() -> None:
    true, order = walk(50, seed=0), np.random.default_rng(0).permutation(50)
    estimated = disturbed(true, seed=1)
    times = np.arange(50.0)
    a, b = Poses(times, estimated), Poses(times, true)
    shuffled = align_trajectories(Poses(times, estimated[order]), Poses(times, true[order]))
    np.testing.assert_allclose(shuffled.rotation, align_trajectories(a, b).rotation, atol=1e-12)
    np.testing.assert_allclose(shuffled.translation, align_trajectories(a, b).translation, atol=1e-12)


def test_few_matching_timestamps_are_reported_with_both_time_ranges() -> None:
    true = Poses(np.arange(300.0), walk(300, seed=0))
    video = Poses(np.arange(300) / 30, walk(300, seed=0))
    (note,) = describe_few_matches(video, true)
    assert note.startswith("Only 10 of 300 estimated poses")
    assert "300 from 0 to 9.96667 s; true: 300 from 0 to 299 s" in note
    assert len(describe_few_matches(Poses(np.arange(12) * 1.5, walk(12, seed=0)), true)) == 1
    assert describe_few_matches(true, true) == []
    assert describe_few_matches(Poses(np.arange(8.0), walk(8, seed=0)), true) == []


def test_trajectories_of_other_recordings_are_refused() -> None:
    true = walk(10, seed=0)
    with pytest.raises(FreeOccError, match="true: 10 from 1000"):
        measure_trajectory_errors(
            Poses(np.arange(10.0), true), Poses(1000 + np.arange(10.0), true), TrajectoryAlignment.identity()
        )


@pytest.mark.parametrize("how", ["se3", "sim3", "none"])
@pytest.mark.parametrize("seed", [0, 7])
def test_errors_agree_with_evo_on_the_same_files(tmp_path: Path, how: str, seed: int) -> None:
    true = walk(400, seed=seed, rests=True)
    estimated = disturbed(true, seed=seed + 1)
    times = 1e9 + np.arange(400) / 30
    rng = np.random.default_rng(seed)
    kept = np.flatnonzero(rng.random(400) < 0.8)
    files = (
        write(tmp_path / "estimated.txt", times[kept] + rng.uniform(-0.004, 0.004, len(kept)), estimated[kept]),
        write(tmp_path / "true.txt", times, true),
    )
    own_est, own_true = (read_poses(path) for path in files)
    alignment = align_trajectories(own_est, own_true, how)
    own = measure_trajectory_errors(own_est, own_true, alignment)

    evo_est, evo_true = (file_interface.read_tum_trajectory_file(path) for path in files)
    evo_true, evo_est = sync.associate_trajectories(evo_true, evo_est, max_diff=0.02)
    if how != "none":
        evo_est.align(evo_true, correct_scale=how == "sim3")
    assert len(own.errors_m) == evo_true.num_poses
    ape = metrics.APE(metrics.PoseRelation.translation_part)
    ape.process_data((evo_true, evo_est))
    theirs = ape.get_all_statistics()
    for name, value in own.as_dict()["ate_m"].items():
        assert value == pytest.approx(theirs[name], abs=1e-6), name
    assert [e.distance_m for e in own.relative] == [0.1, 0.5, 1.0, 2.0]
    for error in own.relative:
        for relation, value in (
            (metrics.PoseRelation.translation_part, error.translation_rmse_m),
            (metrics.PoseRelation.rotation_angle_deg, error.rotation_rmse_deg),
        ):
            rpe = metrics.RPE(
                relation, error.distance_m, metrics.Unit.meters, all_pairs=True, pairs_from_reference=True
            )
            rpe.process_data((evo_true, evo_est))
            assert error.pairs == len(rpe.error)
            assert value == pytest.approx(rpe.get_statistic(metrics.StatisticsType.rmse), abs=1e-6)
