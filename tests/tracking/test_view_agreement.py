"""Keyframes compared with each other: a box of a room whose depth images are known exactly."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from freeocc3d.core.transforms import invert
from freeocc3d.core.types import Frame, Intrinsics
from freeocc3d.tracking import view_agreement
from freeocc3d.tracking.view_agreement import compare_views, find_revisits, measure_agreement, prepare_compared_view

CAMERA = Intrinsics(320, 240, 260.0, 260.0, 159.5, 119.5)
HALF = np.array((2.0, 1.5, 3.0))  # of the room's edges, meters
NOISE = 0.004


def pose(degrees: float, x: float = 0.0, z: float = 0.0) -> NDArray[np.float64]:
    """A camera at (x, 0, z) that is turned about the vertical."""
    T, angle = np.eye(4), np.radians(degrees)
    T[:3, :3] = ((np.cos(angle), 0, np.sin(angle)), (0, 1, 0), (-np.sin(angle), 0, np.cos(angle)))
    T[:3, 3] = x, 0, z
    return T


def frame(T_world_cam: NDArray[np.float64], index: int = 0, noise: float = 0.0, board: float = 0.0) -> Frame:
    """What a camera sees of the room from inside. board: half the width of a thin board at z = 1.2, x = 0, if any."""
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    rays = np.stack(((u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones(u.shape)), axis=-1)
    ways, start = rays @ T_world_cam[:3, :3].T, T_world_cam[:3, 3]
    with np.errstate(divide="ignore"):
        depth = np.min(np.where(ways > 0, HALF - start, -HALF - start) / ways, axis=-1)
        reach = (1.2 - start[2]) / ways[..., 2]
    hit = (reach > 0) & (reach < depth) & (np.abs(start[0] + reach * ways[..., 0]) < board)
    depth = np.where(hit, reach, depth)
    points = start + depth[..., None] * ways
    shade = 120 + 60 * np.sin(3 * points).prod(axis=-1)
    depth += noise * np.random.default_rng(index).normal(size=depth.shape)
    color = np.repeat(shade[..., None], 3, axis=2).astype(np.uint8)
    return Frame(index, float(index), color, depth.astype(np.float32), CAMERA)


def test_right_poses_leave_the_noise_and_wrong_ones_their_error() -> None:
    T = pose(0), pose(14, 0.3, 0.2)
    a, b = (prepare_compared_view(frame(T[n], n)) for n in (0, 1))
    exact = compare_views(b, a, invert(T[0]) @ T[1])
    assert len(exact.off_m) > 2000
    assert np.abs(exact.off_m).max() < 0.01  # a pixel across a corner of the room
    assert np.median(np.abs(exact.off_m)) < 1e-4
    assert np.median(np.abs(exact.gray)) < 1
    assert exact.seen_through == 0
    forward = pose(0, 0, 0.05)  # the wall in front and the side walls move along the axis
    shifted = compare_views(a, a, forward)
    front = np.abs(shifted.points[:, 2] - 3) < 0.01
    assert np.allclose(shifted.off_m[front], 0.05, atol=1e-4)
    noisy = [prepare_compared_view(frame(T[n], n, NOISE)) for n in (0, 1)]
    found = compare_views(noisy[1], noisy[0], invert(T[0]) @ T[1])
    # The target's depth is interpolated between four pixels, so its noise is less.
    assert 1.0 < np.std(found.off_m) / NOISE < 1.45


def test_exposure_does_not_count() -> None:
    a = frame(pose(0))
    b = Frame(1, 1.0, (0.6 * a.color + 30).astype(np.uint8), a.depth_m, CAMERA)
    found = compare_views(prepare_compared_view(b), prepare_compared_view(a), np.eye(4))
    assert np.median(np.abs(found.gray)) < 1


def test_the_back_of_a_board_is_not_its_front() -> None:
    """Two cameras on both sides of a thin board; the rays of one end 15 cm in front of what the other sees."""
    near, far = pose(0, 0, 0), pose(180, 0, 2.4 + 0.15)
    views = [prepare_compared_view(frame(T, board=0.5)) for T in (near, far)]
    found = compare_views(views[0], views[1], invert(far) @ near)
    on_board = np.abs(found.points[:, 2] - 1.2) < 0.01
    assert not on_board.any()


def test_what_a_frame_sees_through_is_told() -> None:
    with_board, without = (prepare_compared_view(frame(pose(0), board=board)) for board in (0.5, 0.0))
    assert compare_views(with_board, without, np.eye(4)).seen_through > 0.1
    assert compare_views(without, with_board, np.eye(4)).seen_through == 0  # the wall behind is hidden


def test_revisits_need_a_look_elsewhere() -> None:
    there, back = [pose(angle) for angle in (0, 25, 50)], [pose(angle) for angle in (0, 90, 180, 90, 3)]

    def revisits(poses: list[NDArray[np.float64]]) -> list[tuple[int, int]]:
        views = [prepare_compared_view(frame(T, n)) for n, T in enumerate(poses)]
        return find_revisits(views, np.array(poses).reshape(-1, 4, 4))

    assert revisits(there) == []
    assert revisits(back) == [(3, 1), (4, 0)]
    assert revisits([]) == []


@pytest.mark.parametrize(("off", "low", "high"), [(0.0, 0.85, 1.25), (0.04, 2.5, 25)])
def test_drift_shows_at_revisits_alone(off: float, low: float, high: float) -> None:
    """A whole turn and a quarter, along which the camera drifts by as many meters."""
    angles = np.arange(0, 450, 20)
    true = np.stack([pose(angle, 0.2 * np.sin(0.3 * n)) for n, angle in enumerate(angles)])
    views = [prepare_compared_view(frame(T, n, NOISE)) for n, T in enumerate(true)]
    drifting = true.copy()
    drifting[:, :3, 3] += np.linspace(0, off, len(true))[:, None] * (0.7, 0.1, 0.7)
    found = measure_agreement(views, drifting)
    step, revisit = (np.median([pair.sigmas for pair in pairs]) for pairs in (found.steps, found.revisits))
    assert len(found.steps) == len(angles) - 1
    assert all(pair.source - pair.target > 9 for pair in found.revisits)
    assert low < revisit / step < high


def test_pairs_that_share_too_little_are_left_out() -> None:
    views = [prepare_compared_view(frame(T, n)) for n, T in enumerate((pose(0), pose(180)))]
    assert measure_agreement(views, np.stack((pose(0), pose(180)))).steps == []
    assert measure_agreement(views[:1], np.eye(4)[None]) == view_agreement.Agreement([], [])
    assert measure_agreement([], np.zeros((0, 4, 4))) == view_agreement.Agreement([], [])


def test_a_smooth_error_of_the_sensor_is_told_from_noise() -> None:
    """Two turns through the room, the second one with the camera turned and tilted another way."""
    rng = np.random.default_rng(1)
    poses = []
    for angle in range(0, 720, 40):
        tilted, tilt = pose(angle, *rng.uniform(-0.6, 0.6, 2)), np.radians(rng.uniform(-35, 35))
        roll = np.eye(4)
        roll[:2, :2] = ((np.cos(tilt), -np.sin(tilt)), (np.sin(tilt), np.cos(tilt)))
        poses.append(tilted @ roll)
    true = np.stack(poses)
    x, y = (np.mgrid[: CAMERA.height, : CAMERA.width][::-1] - np.array([[[CAMERA.cx]], [[CAMERA.cy]]])) / 160
    for c in (np.zeros(3), np.array((0.006, -0.003, 0.002))):
        frames = [frame(T, n, NOISE) for n, T in enumerate(true)]
        wrong = [f.depth_m + f.depth_m**2 * (c[0] * x + c[1] * y + c[2] * (x**2 + y**2)) for f in frames]
        views = [
            prepare_compared_view(replace(f, depth_m=d.astype(np.float32))) for f, d in zip(frames, wrong, strict=True)
        ]
        found = view_agreement.measure_distortion(views, true, measure_agreement(views, true).revisits)
        assert np.abs(found - c).max() < 5e-4
