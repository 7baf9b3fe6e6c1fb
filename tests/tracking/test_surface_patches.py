"""Flat patches of depth images of planes whose places are known."""

import numpy as np
import pytest
from scenes import CAMERA

from freeocc3d.core.depth_sensors import STRUCTURED_LIGHT
from freeocc3d.core.transforms import invert, quats_to_rotations
from freeocc3d.core.types import Intrinsics
from freeocc3d.tracking.upright.surface_patches import CELL_M, find_patches, find_surface_patches

LARGE = Intrinsics(640, 480, 525.0, 520.0, 310.0, 250.0)


def depth_of(plane: tuple[float, float, float, float], camera: Intrinsics) -> np.ndarray:
    """Depth of the plane (a, b, c, d) with a X + b Y + c Z = d, in the camera's frame."""
    v, u = np.indices((camera.height, camera.width))
    slope = plane[0] * (u - camera.cx) / camera.fx + plane[1] * (v - camera.cy) / camera.fy + plane[2]
    return np.where(slope > 0.05, plane[3] / np.maximum(slope, 0.05), 0).astype(np.float32)


@pytest.mark.parametrize("camera", [CAMERA, LARGE], ids=["small", "large"])
@pytest.mark.parametrize("normal", [(0, 0, 1), (0.6, 0, 0.8), (0.1, 0.7, 0.7)])
def test_patches_of_a_plane_lie_on_it_and_face_the_camera(camera, normal) -> None:
    normal = np.array(normal) / np.linalg.norm(normal)
    points, normals, _ = find_patches(depth_of((*normal, 2.0), camera), STRUCTURED_LIGHT, camera)
    assert len(points) > 100
    np.testing.assert_allclose(points @ normal, 2.0, atol=1e-4)
    np.testing.assert_allclose(normals, np.tile(-normal, (len(points), 1)), atol=1e-3)


def test_edges_and_holes_are_left_out() -> None:
    depth = depth_of((0, 0, 1, 2.0), CAMERA)
    depth[:, 84:] = 3.0  # within a patch
    depth[40:48, 16:23] = 0.0
    depth[50, 20] = 0.0  # one pixel leaves enough of a patch
    points, normals, _ = find_patches(depth, STRUCTURED_LIGHT, CAMERA)
    assert set(np.round(points[:, 2], 3)) == {2.0, 3.0}
    assert len(points) == (CAMERA.height // 8) * (CAMERA.width // 8 - 1) - 1
    np.testing.assert_allclose(normals[:, 2], -1, atol=1e-4)


def test_a_surface_counts_by_its_area_in_the_world() -> None:
    T = np.eye(4)
    quat = np.array((0.9, 0.1, -0.3, 0.2))
    T[:3, :3], T[:3, 3] = quats_to_rotations(quat / np.linalg.norm(quat)), (1, -2, 0.5)
    depth = depth_of((0, 0, 1, 2.0), CAMERA)
    image = depth, STRUCTURED_LIGHT, CAMERA
    once = find_surface_patches([image], T[None])
    often = find_surface_patches([image] * 5, np.tile(T, (5, 1, 1)))
    assert len(once) == len(often) > 250
    np.testing.assert_allclose(often.points, once.points, atol=1e-9)
    assert len(np.unique(np.floor(once.points / CELL_M), axis=0)) == len(once)
    back = once.moved(invert(T))
    np.testing.assert_allclose(back.points[:, 2], 2.0, atol=1e-4)
    np.testing.assert_allclose(back.normals[:, 2], -1, atol=1e-4)


def test_a_board_that_is_seen_from_both_sides_is_left_out() -> None:
    depth, behind = depth_of((0, 0, 1, 2.0), CAMERA), np.diag((-1.0, 1.0, -1.0, 1.0))
    behind[2, 3] = 4.0
    images = [(depth, STRUCTURED_LIGHT, CAMERA)] * 2
    assert len(find_surface_patches(images, np.stack((np.eye(4), behind)))) < 100
    assert len(find_surface_patches([], np.zeros((0, 4, 4)))) == 0


def test_sparse_depth_shows_the_same_plane() -> None:
    normal = np.array((0.1, 0.7, 0.7)) / np.linalg.norm((0.1, 0.7, 0.7))
    depth = depth_of((*normal, 2.0), CAMERA)
    depth[np.random.default_rng(0).random(depth.shape) < 0.5] = 0
    points, normals, _ = find_patches(depth, STRUCTURED_LIGHT, CAMERA)
    assert len(points) > 100
    np.testing.assert_allclose(points @ normal, 2.0, atol=1e-4)
    np.testing.assert_allclose(normals, np.tile(-normal, (len(points), 1)), atol=1e-3)


def test_rough_depth_shows_patches_where_it_states_that_it_is_rough() -> None:
    depth = depth_of((0, 0, 1, 2.0), CAMERA)
    depth += np.random.default_rng(0).normal(0, 0.05, depth.shape).astype(np.float32)
    assert len(find_patches(depth, STRUCTURED_LIGHT, CAMERA)[0]) == 0
    assert len(find_patches(depth, np.full_like(depth, 0.05), CAMERA)[0]) > 250
