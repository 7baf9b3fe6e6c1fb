"""The joint refinement's linear algebra, against dense solutions, and which views count."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from freeocc3d.tracking.overlap import DepthView
from freeocc3d.tracking.rgbd import dense_alignment, joint_refinement
from freeocc3d.tracking.rgbd.keyframe_registration import FeatureMatches


def some_pose(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    T = np.eye(4)
    T[:3, :3] = Rotation.random(random_state=seed).as_matrix()
    T[:3, 3] = rng.normal(size=3)
    return T


def twist(xi: np.ndarray) -> np.ndarray:
    """(4, 4) generator of a rotation and a translation."""
    w, v = xi[:3], xi[3:]
    return np.block(
        [
            [np.array(((0, -w[2], w[1]), (w[2], 0, -w[0]), (-w[1], w[0], 0))), v[:, None]],
            [np.zeros((1, 4))],
        ]
    )


@pytest.mark.parametrize("seed", range(3))
def test_a_motion_is_moved_to_another_frame_by_the_adjoint(seed: int) -> None:
    T, xi = some_pose(seed), np.random.default_rng(seed).normal(size=6)
    moved = T @ expm(twist(xi)) @ np.linalg.inv(T)
    np.testing.assert_allclose(moved, expm(twist(joint_refinement._adjoint(T[None])[0] @ xi)), atol=1e-9)
    small = 1e-3 * xi
    found = joint_refinement._measure_motion(T[None], (expm(twist(small)) @ T)[None])[0]
    np.testing.assert_allclose(found, small, atol=1e-5)


def test_steps_minimize_the_sum_over_all_pairs_and_the_first_keyframe_stays() -> None:
    rng = np.random.default_rng(0)
    ends = [(1, 0), (2, 1), (3, 2), (3, 0), (2, 0)]
    root = rng.normal(size=(5, 6, 6))
    information, gradients = 100 * root @ root.swapaxes(1, 2), rng.normal(size=(5, 6))
    step = joint_refinement._solve(*np.transpose(ends), information, gradients, 5)
    M, g = np.zeros((30, 30)), np.zeros(30)
    for (source, target), H, gradient in zip(ends, information, gradients, strict=True):
        J = np.zeros((6, 30))
        J[:, 6 * source : 6 * source + 6], J[:, 6 * target : 6 * target + 6] = np.eye(6), -np.eye(6)
        M += J.T @ H @ J
        g += J.T @ gradient
    held = M + np.diag(1.0 + 1e-4 * np.diag(M))
    wanted = np.concatenate((np.zeros(6), np.linalg.solve(held[6:, 6:], -g[6:]))).reshape(5, 6)
    np.testing.assert_allclose(step, wanted, atol=1e-9)
    assert not step[4].any(), "nothing ties the last keyframe to others"


def test_pairs_are_linearized_again_only_where_they_moved_and_meet_the_same_minimum(monkeypatch) -> None:
    """Pairs whose residual is the motion from a wanted pose: one step ends at the minimum, which a second one finds
    from the equations of the first wherever pairs have not moved."""
    ends = [(1, 0), (2, 1), (3, 2), (3, 0)]
    true = [some_pose(seed) for seed in range(4)]
    start = np.stack([expm(twist(np.full(6, off))) @ T for T, off in zip(true, (0, 0, 0, 2e-3), strict=True)])
    linearized = []

    def linearize(pair, keyframes, T_ts) -> None:
        wanted = np.linalg.inv(true[pair.target]) @ true[pair.source]
        pair.linearized_at, pair.H = T_ts, 1e6 * np.eye(6)
        pair.g = -pair.H @ joint_refinement._measure_motion(T_ts[None], wanted[None])[0]
        linearized.append((pair.source, pair.target))

    monkeypatch.setattr(joint_refinement, "_linearize", linearize)
    pairs = [joint_refinement._Pair(*pair, FeatureMatches(np.zeros((0, 3)), np.zeros((0, 2)))) for pair in ends]
    with ThreadPoolExecutor(1) as pool:
        assert joint_refinement._step(pairs, [], start, pool)
        assert sorted(linearized) == sorted(ends)
        linearized.clear()
        assert joint_refinement._step(pairs, [], start, pool)
        assert sorted(linearized) == [(3, 0), (3, 2)], "the last keyframe's, which moved"
        np.testing.assert_allclose(start, true, atol=2e-5)
        while joint_refinement._step(pairs, [], start, pool):
            pass
    np.testing.assert_allclose(start, true, atol=2e-5)


def test_the_middle_of_what_a_keyframe_sees_is_in_the_world() -> None:
    points = np.float32([(0, 0, 1), (1, 2, 3), (9, 9, 9)])
    T = some_pose(1)
    seen = joint_refinement._seen(SimpleNamespace(overlap=DepthView(None, None, points)), T)  # type: ignore[arg-type]
    np.testing.assert_allclose(seen, T[:3, :3] @ (1, 2, 3) + T[:3, 3])
    none = joint_refinement._seen(SimpleNamespace(overlap=DepthView(None, None, points[:0])), T)  # type: ignore[arg-type]
    np.testing.assert_allclose(none, T[:3, 3])


@pytest.mark.parametrize(
    ("pixels", "share", "correlation", "counts"),
    [
        (0.0501, 0.9, 0.9, True),
        (0.0499, 0.9, 0.9, False),
        (1.0, 0.5, 0.9, True),
        (1.0, 0.499, 0.9, False),
        (1.0, 0.9, 0.5, True),
        (1.0, 0.9, 0.499, False),
        (1.0, 0.9, float("nan"), True),
    ],
)
def test_pairs_that_disagree_are_left_out(pixels, share, correlation, counts, monkeypatch) -> None:
    def linearized(source, target, camera, T, stride, weighting, equations) -> None:
        assert stride == 2
        np.testing.assert_allclose(T, np.linalg.inv(poses[0]) @ poses[1])
        equations[0][:], equations[1][:] = np.diag(np.arange(1.0, 9.0)), np.arange(8.0)
        equations[2][1] = pixels * 80 * 60 / 4

    poses = [some_pose(0), some_pose(1)]
    view = SimpleNamespace(levels=[None], camera=None, points=np.zeros((60, 80, 3)))
    keyframe = SimpleNamespace(view=view, camera=SimpleNamespace(fx=50.0))
    matched = FeatureMatches(np.zeros((0, 3), np.float32), np.zeros((0, 2), np.float32))
    pair = joint_refinement._Pair(1, 0, matched)
    monkeypatch.setattr(joint_refinement, "linearize", linearized)
    monkeypatch.setattr(dense_alignment, "compute_correlation", lambda stats: correlation)
    monkeypatch.setattr(dense_alignment, "compute_inlier_share", lambda stats: share)
    joint_refinement._linearize(pair, [keyframe, keyframe], np.linalg.inv(poses[0]) @ poses[1])
    assert pair.H.any() == counts
    if counts:
        agreement = 1.0 if np.isnan(correlation) else (correlation - 0.5) / 0.5
        assert pair.weighting.photometric == pytest.approx(dense_alignment.PHOTOMETRIC * agreement**4)
        damping = dense_alignment.BRIGHTNESS_DAMPING
        np.testing.assert_allclose(pair.weighting.brightness, (1 - 6 / (7 + damping), -7 / (8 + damping)))
