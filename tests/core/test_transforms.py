"""Transforms, quaternions, projection and alignment, each against its inverse or a known answer."""

import numpy as np
import pytest
from numpy.typing import NDArray

from freeocc3d.core.errors import FreeOccError
from freeocc3d.core.transforms import (
    back_project,
    invert,
    is_rigid,
    multiply_quats,
    nearest_rigid,
    project,
    quats_to_rotations,
    rotations_to_quats,
    transform,
    umeyama,
)
from freeocc3d.core.types import Intrinsics

CAMERA = Intrinsics(64, 48, 50.0, 52.0, 31.0, 24.5)


def unit_quats(n: int, seed: int) -> NDArray[np.float64]:
    quats = np.random.default_rng(seed).normal(size=(n, 4))
    return quats / np.linalg.norm(quats, axis=1, keepdims=True)


def rigid(n: int, seed: int) -> NDArray[np.float64]:
    T = np.tile(np.eye(4), (n, 1, 1))
    T[:, :3, :3] = quats_to_rotations(unit_quats(n, seed))
    T[:, :3, 3] = np.random.default_rng(seed + 1).uniform(-5, 5, (n, 3))
    return T


def test_invert_undoes_a_transform() -> None:
    T = rigid(20, seed=0).reshape(4, 5, 4, 4)
    np.testing.assert_allclose(invert(T) @ T, np.broadcast_to(np.eye(4), T.shape), atol=1e-12)
    np.testing.assert_allclose(invert(T[0, 0]), np.linalg.inv(T[0, 0]), atol=1e-12)


def test_transform_moves_points_and_keeps_their_type() -> None:
    T = rigid(1, seed=0)[0]
    points = np.random.default_rng(1).normal(size=(3, 4, 3)).astype(np.float32)
    moved = transform(T, points)
    assert moved.dtype == np.float32
    homogeneous = np.concatenate((points, np.ones((3, 4, 1))), axis=-1) @ T.T
    np.testing.assert_allclose(moved, homogeneous[..., :3], rtol=1e-5, atol=1e-5)


def test_is_rigid_tells_rotations_from_the_rest() -> None:
    T = rigid(1, seed=0)[0]
    assert is_rigid(T)
    mirrored, scaled, lost, projective = T.copy(), T.copy(), T.copy(), T.copy()
    mirrored[:3, 0] *= -1
    scaled[:3, :3] *= 1.01
    lost[0, 3] = -np.inf
    projective[3, 0] = 0.1
    assert not any(is_rigid(bad) for bad in (mirrored, scaled, lost, projective, T[:3]))


def test_nearest_rigid_keeps_a_rigid_transform_and_mends_others() -> None:
    T = rigid(1, seed=0)[0]
    np.testing.assert_allclose(nearest_rigid(T), T, atol=1e-12)
    disturbed = T.copy()
    disturbed[:3, :3] += np.random.default_rng(0).normal(0, 0.05, (3, 3))
    mended = nearest_rigid(disturbed)
    assert is_rigid(mended, tolerance=1e-12)
    np.testing.assert_array_equal(mended[:3, 3], T[:3, 3])
    # Nothing near it is nearer.
    distance = np.linalg.norm(mended[:3, :3] - disturbed[:3, :3])
    for quat in unit_quats(20, seed=3) * 0.01 + (1, 0, 0, 0):
        other = quats_to_rotations(quat / np.linalg.norm(quat)) @ mended[:3, :3]
        assert np.linalg.norm(other - disturbed[:3, :3]) >= distance - 1e-12


def test_nearest_rigid_of_a_mirrored_estimate_is_a_rotation() -> None:
    mirrored = np.diag((1.0, 1.0, -0.1, 1.0))
    assert is_rigid(nearest_rigid(mirrored))


def test_quaternions_of_known_rotations() -> None:
    half = np.sqrt(0.5)
    quarter_turn_about_z = np.array([half, 0, 0, half])
    np.testing.assert_allclose(quats_to_rotations(quarter_turn_about_z), [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-12)
    np.testing.assert_allclose(rotations_to_quats(np.eye(3)), [1, 0, 0, 0])


def test_quaternions_and_rotations_are_inverse() -> None:
    quats = unit_quats(500, seed=0)
    back = rotations_to_quats(quats_to_rotations(quats))
    assert (back[:, 0] >= 0).all()
    np.testing.assert_allclose(back, np.where(quats[:, :1] < 0, -quats, quats), atol=1e-12)


@pytest.mark.parametrize("tilt", [0.0, 1e-9, 1e-5])
def test_half_turns_survive_the_round_trip(tilt: float) -> None:
    axes = np.concatenate((np.eye(3), -np.eye(3), np.random.default_rng(0).normal(size=(100, 3))))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    quats = np.concatenate((np.full((len(axes), 1), tilt), axes), axis=1)
    R = quats_to_rotations(quats / np.linalg.norm(quats, axis=1, keepdims=True))
    back = rotations_to_quats(R)
    assert np.isfinite(back).all()
    np.testing.assert_allclose(np.linalg.norm(back, axis=1), 1.0)
    np.testing.assert_allclose(quats_to_rotations(back), R, atol=1e-12)


def test_product_of_quaternions_is_product_of_rotations() -> None:
    a, b = unit_quats(50, seed=1), unit_quats(50, seed=2)
    np.testing.assert_allclose(
        quats_to_rotations(multiply_quats(a, b)), quats_to_rotations(a) @ quats_to_rotations(b), atol=1e-12
    )


def test_project_and_back_project_are_inverse() -> None:
    rng = np.random.default_rng(0)
    pixels, depth = rng.uniform((0, 0), (64, 48), (6, 7, 2)), rng.uniform(0.3, 6.0, (6, 7))
    points = back_project(pixels, depth, CAMERA)
    np.testing.assert_array_equal(points[..., 2], depth)
    found_pixels, found_depth = project(points, CAMERA)
    np.testing.assert_allclose(found_pixels, pixels, atol=1e-9)
    np.testing.assert_array_equal(found_depth, depth)


def test_projection_agrees_with_the_calibration_matrix() -> None:
    point = np.array([0.2, -0.1, 2.0])
    homogeneous = CAMERA.matrix @ point
    np.testing.assert_allclose(project(point, CAMERA)[0], homogeneous[:2] / homogeneous[2])


def test_points_not_in_front_of_the_camera_have_no_pixel() -> None:
    pixels, depth = project(np.array([[0.0, 0, -1], [1, 0, 0], [0, 0, 1]]), CAMERA)
    assert np.isnan(pixels[:2]).all()
    np.testing.assert_allclose(pixels[2], (31.0, 24.5))
    assert depth.tolist() == [-1, 0, 1]


@pytest.mark.parametrize("seed", range(5))
def test_umeyama_recovers_a_similarity(seed: int) -> None:
    rng = np.random.default_rng(seed)
    source, T, scale = rng.normal(size=(30, 3)), rigid(1, seed)[0], rng.uniform(0.1, 10)
    target = scale * source @ T[:3, :3].T + T[:3, 3]
    found_scale, R, t = umeyama(source, target, with_scale=True)
    assert found_scale == pytest.approx(scale)
    np.testing.assert_allclose(R, T[:3, :3], atol=1e-9)
    np.testing.assert_allclose(t, T[:3, 3], atol=1e-9)


def test_umeyama_is_a_minimum_under_noise() -> None:
    rng = np.random.default_rng(0)
    source = rng.normal(size=(50, 3))
    target = 1.7 * transform(rigid(1, 4)[0], source) + rng.normal(0, 0.05, (50, 3))

    def cost(scale: float, R: NDArray[np.float64], t: NDArray[np.float64]) -> float:
        return float(((target - (scale * source @ R.T + t)) ** 2).sum())

    scale, R, t = umeyama(source, target, with_scale=True)
    least = cost(scale, R, t)
    for step in rng.normal(0, 0.01, (50, 7)):
        quat = np.concatenate(([1.0], step[:3]))
        turned = quats_to_rotations(quat / np.linalg.norm(quat)) @ R
        assert cost(scale + step[3], turned, t + step[4:]) > least


def test_umeyama_without_scale_keeps_it_one() -> None:
    source = np.random.default_rng(0).normal(size=(30, 3))
    scale, R, _ = umeyama(source, 3.0 * source, with_scale=False)
    assert scale == 1.0
    np.testing.assert_allclose(R, np.eye(3), atol=1e-9)


def test_umeyama_of_a_mirror_image_is_a_rotation() -> None:
    source = np.random.default_rng(0).normal(size=(30, 3))
    for with_scale in (False, True):
        _, R, _ = umeyama(source, source * (1, 1, -1), with_scale)
        assert np.linalg.det(R) == pytest.approx(1.0)


def test_umeyama_needs_a_plane_of_points_only() -> None:
    source = np.random.default_rng(0).normal(size=(10, 3)) * (1, 1, 0)
    T = rigid(1, seed=2)[0]
    _, R, t = umeyama(source, transform(T, source), with_scale=True)
    np.testing.assert_allclose(R, T[:3, :3], atol=1e-9)
    np.testing.assert_allclose(t, T[:3, 3], atol=1e-9)


@pytest.mark.parametrize(
    "source",
    [
        np.zeros((0, 3)),
        np.eye(3)[:2],
        np.ones((10, 3)),
        np.arange(10.0)[:, None] * (1, 2, 3),
    ],
    ids=["none", "two", "one place", "a line"],
)
def test_umeyama_refuses_what_leaves_the_rotation_open(source: NDArray[np.float64]) -> None:
    with pytest.raises(FreeOccError, match="Alignment"):
        umeyama(source, source + 1.0, with_scale=True)
