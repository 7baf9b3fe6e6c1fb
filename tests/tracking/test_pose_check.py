"""Given poses against depth: right ones agree, and every usual mistake is named."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from freeocc3d.capture import open_capture
from freeocc3d.core.errors import TrackingError
from freeocc3d.core.transforms import invert, quats_to_rotations, rotations_to_quats
from freeocc3d.tracking.pose_check import check_poses, compare_poses
from freeocc3d.tracking.rgbd.measured_pairs import MeasuredPair, measure_pairs

Poses = NDArray[np.float64]


@pytest.fixture(scope="module")
def room() -> tuple[Poses, list[MeasuredPair]]:
    """True poses of the built-in room, and measured pairs of its frames."""
    capture = open_capture("builtin:room", None, {"synthetic": {"frames": 120, "width": 160, "height": 120}})
    poses = np.stack([capture.pose(index) for index in range(len(capture))])  # type: ignore[misc]
    return poses, measure_pairs(capture, range(len(capture)))


def scaled(factor: float) -> Callable[[Poses], Poses]:
    def change(T: Poses) -> Poses:
        T = T.copy()
        T[:, :3, 3] *= factor
        return T

    return change


def in_axes(*columns: tuple[int, int, int]) -> Callable[[Poses], Poses]:
    """Poses of a camera whose axes are the columns in those that are stated."""
    S = np.eye(4)
    S[:3, :3] = np.array(columns, float).T
    return lambda T: T @ np.linalg.inv(S)


def mirrored(T: Poses) -> Poses:
    """A left-handed world with y up, as Unity's."""
    M = np.diag([1.0, -1.0, 1.0, 1.0])
    return np.asarray(M @ T @ M)


def reordered(T: Poses) -> Poses:
    T = T.copy()
    T[:, :3, :3] = quats_to_rotations(np.roll(rotations_to_quats(T[:, :3, :3]), 1, axis=1))
    return T


def on_body(T: Poses) -> Poses:
    """Poses of a robot on which the camera looks forward and down, 20 cm before and 1 m above the base."""
    turn = np.radians(15)
    X = np.eye(4)
    X[:3, :3] = np.array([[0, -np.sin(turn), np.cos(turn)], [-1, 0, 0], [0, -np.cos(turn), -np.sin(turn)]])
    X[:3, 3] = 0.2, 0.0, 1.0
    return np.asarray(T @ np.linalg.inv(X))


def shifted_in_time(T: Poses) -> Poses:
    return np.roll(T, 10, axis=0)


MISTAKES: dict[str, tuple[Callable[[Poses], Poses], str]] = {
    "inverted": (invert, "world-to-camera"),
    "centimeters": (scaled(100), "0.01 m (centimeters)"),
    "millimeters": (scaled(1000), "0.001 m (millimeters)"),
    "an odd unit": (scaled(1 / 3), "a unit of their positions were 3"),
    "opengl": (in_axes((1, 0, 0), (0, -1, 0), (0, 0, -1)), "OpenGL"),
    "robot": (in_axes((0, -1, 0), (0, 0, -1), (1, 0, 0)), "robot"),
    "other axes": (in_axes((0, 1, 0), (0, 0, 1), (1, 0, 0)), "axes were others"),
    "unity": (mirrored, "left-handed"),
    "wxyz": (reordered, "quaternions"),
    "inverted, centimeters": (lambda T: scaled(100)(invert(T)), "inverted"),
    "opengl, millimeters": (lambda T: scaled(1000)(in_axes((1, 0, 0), (0, -1, 0), (0, 0, -1))(T)), "OpenGL"),
    "body": (on_body, "m and 129 degrees from the body"),
    "times": (shifted_in_time, "10 frames later"),
}


def test_right_poses_agree(room) -> None:
    poses, pairs = room
    found = compare_poses(poses, pairs)
    assert found.right
    assert found.agreeing >= 0.9 * found.pairs
    assert check_poses(poses, pairs, "the room") is None


@pytest.mark.parametrize("name", MISTAKES)
def test_a_mistake_is_refused_with_its_cause(room, name: str) -> None:
    poses, pairs = room
    change, words = MISTAKES[name]
    with pytest.raises(TrackingError, match=r"The poses of the room do not agree with the depth: .* pairs") as caught:
        check_poses(change(poses), pairs, "the room")
    assert words in str(caught.value)


def test_noise_and_drift_as_trackers_have_them_pass(room) -> None:
    poses, pairs = room
    rng = np.random.default_rng(0)
    noisy = poses.copy()
    noisy[:, :3, 3] += rng.normal(0, 0.01, (len(poses), 3)) + np.linspace(0, 0.3, len(poses))[:, None]
    assert compare_poses(noisy, pairs).right


@pytest.mark.parametrize(("factor", "right"), [(1.1, True), (1 / 1.1, True), (1.25, False), (0.8, False)])
def test_a_unit_that_is_off_is_noticed_where_turns_dominate(room, factor: float, right: bool) -> None:
    poses, pairs = room
    assert compare_poses(scaled(factor)(poses), pairs).right == right


def test_poses_of_another_scan_are_refused_without_a_cause(room) -> None:
    poses, pairs = room
    rng = np.random.default_rng(1)
    quats = rng.normal(size=(len(poses), 4))
    other = np.tile(np.eye(4), (len(poses), 1, 1))
    other[:, :3, :3] = quats_to_rotations(quats / np.linalg.norm(quats, axis=1, keepdims=True))
    other[:, :3, 3] = rng.normal(size=(len(poses), 3))
    with pytest.raises(TrackingError, match="Check that the poses belong to this capture"):
        check_poses(other, pairs, "the room")


def test_frames_without_poses_and_few_pairs_say_nothing(room) -> None:
    poses, pairs = room
    some = poses.copy()
    some[::3] = np.nan
    assert compare_poses(some, pairs).right
    assert compare_poses(np.full_like(poses, np.nan), pairs).pairs == 0
    assert compare_poses(invert(poses), pairs[:5]).right
