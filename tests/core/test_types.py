"""What the layers hand to each other."""

import dataclasses

import numpy as np
import pytest
from scenes import random_gaussians

from freeocc3d.core.transforms import project
from freeocc3d.core.types import FREE, OCCUPIED, UNKNOWN, Intrinsics, Occupancy, Trajectory


def occupancy() -> Occupancy:
    """Two blocks; three occupied voxels and one free one."""
    keys = np.array([[0, 0, 0], [-1, 2, 0]], np.int32)
    state = np.full((2, 512), UNKNOWN, np.uint8)
    state[0, [0, 64 + 8 * 2 + 3]] = OCCUPIED
    state[1, 511] = OCCUPIED
    state[1, 0] = FREE
    zeros = np.zeros((2, 512), np.uint16)
    return Occupancy(0.1, np.array([1.0, 0.0, -1.0]), keys, np.zeros((2, 512), np.float32), zeros, zeros, state)


def test_voxels_are_numbered_across_blocks() -> None:
    assert occupancy().occupied_voxels().tolist() == [[0, 0, 0], [1, 2, 3], [-1, 23, 7]]
    assert occupancy().voxels(FREE).tolist() == [[-8, 16, 0]]


def test_voxel_centers_lie_half_an_edge_from_the_corner() -> None:
    grid = occupancy()
    np.testing.assert_allclose(
        grid.centers(np.array([[0, 0, 0], [-1, 2, 3]], np.int32)), [[1.05, 0.05, -0.95], [0.95, 0.25, -0.65]]
    )


def test_replace_leaves_the_original() -> None:
    grid = occupancy()
    assert grid.replace(voxel_size=0.2).voxel_size == 0.2
    assert grid.voxel_size == 0.1


def test_resized_camera_sees_the_same_directions() -> None:
    camera = Intrinsics(640, 480, 585.0, 580.0, 320.0, 240.0)
    small = camera.resized(160, 240)
    corners = np.array([[-0.5, -0.5], [639.5, 479.5]])  # the outer edges of the corner pixels
    rays = np.concatenate(((corners - (320.0, 240.0)) / (585.0, 580.0), np.ones((2, 1))), axis=1)
    np.testing.assert_allclose(project(rays, small)[0], [[-0.5, -0.5], [159.5, 239.5]])
    restored = dataclasses.astuple(small.resized(640, 480))
    np.testing.assert_allclose(restored, dataclasses.astuple(camera))


def test_camera_matrix() -> None:
    np.testing.assert_array_equal(Intrinsics(4, 3, 5.0, 6.0, 1.5, 1.0).matrix, [[5, 0, 1.5], [0, 6, 1], [0, 0, 1]])


def test_gaussians_are_selected_by_row() -> None:
    all_of_them = random_gaussians(20, seed=0)
    rows = np.array([3, 17, 5])
    some = all_of_them[rows]
    assert len(some) == 3
    for name in all_of_them.__dataclass_fields__:
        np.testing.assert_array_equal(getattr(some, name), getattr(all_of_them, name)[rows])
    assert len(all_of_them[:4]) == 4


def test_trajectory_tells_frames_without_a_pose() -> None:
    T = np.tile(np.eye(4), (4, 1, 1))
    T[1] = np.nan
    T[2, 0, 3] = np.inf
    T[3, 0, 3] = 7.0
    status = np.array(["keyframe", "lost", "broken", "keyframe"])
    trajectory = Trajectory(np.arange(4.0), T, np.array([0, 3], np.int32), status, np.ones(4, np.float32))
    assert len(trajectory) == 4
    assert trajectory.has_pose.tolist() == [True, False, False, True]
    assert trajectory.T_world_keyframe[:, 0, 3].tolist() == [0.0, 7.0]


def test_what_is_handed_over_cannot_be_reassigned() -> None:
    with pytest.raises(dataclasses.FrozenInstanceError):
        occupancy().voxel_size = 1.0  # type: ignore[misc]
