"""Lifting, cells, the ray-aligned initialization, and anchors that follow their keyframes."""

import numpy as np
import pytest
from scenes import CAMERA, lifted, wall_frame, with_sigma

from freeocc3d.core.depth_sensors import STRUCTURED_LIGHT
from freeocc3d.core.transforms import project, quats_to_rotations, transform
from freeocc3d.core.types import Frame, Intrinsics
from freeocc3d.gaussians import anchors, depth_edges
from freeocc3d.occupancy import splat, splat_reference

CELL = 0.04


def random_pose(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    quat = rng.normal(size=4)
    T = np.eye(4)
    T[:3, :3] = quats_to_rotations(quat / np.linalg.norm(quat))
    T[:3, 3] = rng.uniform(-2, 2, 3)
    return T


def test_a_wall_becomes_one_gaussian_per_cell_on_the_wall() -> None:
    g = lifted([wall_frame(2.0)], [np.eye(4)])
    np.testing.assert_allclose(g.means[:, 2], 2.0, atol=1e-5)
    index = np.floor(g.means.astype(np.float64) / CELL).astype(int)
    assert len(np.unique(index, axis=0)) == len(g)
    area = (CAMERA.width * 2.0 / CAMERA.fx) * (CAMERA.height * 2.0 / CAMERA.fy)
    assert len(g) == pytest.approx(area / CELL**2, rel=0.1)


def test_the_number_of_gaussians_grows_with_the_surface_not_with_the_frames() -> None:
    once = lifted([wall_frame(2.0)], [np.eye(4)])
    ten_times = lifted([wall_frame(2.0, i) for i in range(10)], [np.eye(4)] * 10)
    assert len(ten_times) == len(once)


def test_averaging_over_keyframes_beats_the_noise_of_one() -> None:
    frames = [wall_frame(1.88, i, seed=i) for i in range(20)]
    one, many = (lifted(frames[:n], [np.eye(4)] * n, cell=0.25) for n in (1, 20))
    assert np.std(many.means[:, 2]) < 0.5 * np.std(one.means[:, 2])


def test_a_near_measurement_outweighs_a_far_one_by_its_uncertainty() -> None:
    # The same cell of a wall at z = 2.1 seen from 1 m at 2.10, and from 4 m (behind) at 2.14.
    near, far = np.eye(4), np.eye(4)
    near[2, 3], far[2, 3] = 1.1, -1.86
    g = lifted([wall_frame(1.0), wall_frame(4.0)], [near, far], cell=0.25)
    middle = np.abs(g.means[:, :2]).max(axis=1) < 0.3
    sigma = STRUCTURED_LIGHT.compute_sigma(np.float32([1.0, 4.0]))
    assert sigma[1] / sigma[0] > 10
    assert np.abs(g.means[middle, 2] - 2.10).max() < 0.004
    assert (g.anchor_keyframe[middle] == 0).all()


def test_means_are_their_anchors_in_their_keyframes_and_keep_pixel_and_depth() -> None:
    frames, poses = [wall_frame(2.0, 0), wall_frame(1.5, 1)], [random_pose(0), random_pose(1)]
    g = lifted(frames, poses)
    for k, T in enumerate(poses):
        own = g.anchor_keyframe == k
        assert own.sum() > 100
        np.testing.assert_allclose(transform(T, g.anchor_cam[own].astype(float)), g.means[own], atol=1e-5)
        pixels, depth = project(g.anchor_cam[own], CAMERA)
        np.testing.assert_allclose(depth, frames[k].depth_m[0, 0], atol=1e-4)
        assert (pixels > -1).all()
        assert (pixels < (CAMERA.width, CAMERA.height)).all()


def test_ray_aligned_initialization_is_the_papers() -> None:
    T = random_pose(3)
    g = lifted([wall_frame(2.0)], [T], gamma=2.5, coverage=0.5, initialization="ray_aligned")
    np.testing.assert_allclose(g.scales[:, 2], 2.5 * g.scales[:, 0], rtol=1e-6)
    np.testing.assert_array_equal(g.scales[:, 0], g.scales[:, 1])
    ray = g.means - T[:3, 3]
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    local_z = quats_to_rotations(g.quats_wxyz.astype(float))[:, :, 2]
    np.testing.assert_allclose(local_z, ray, atol=1e-4)


def test_discs_lie_on_the_surface_as_thick_as_their_place_is_uncertain() -> None:
    T = random_pose(3)
    g = lifted([wall_frame(2.0)], [T], coverage=0.5)
    np.testing.assert_allclose(g.scales[:, :2], 0.5 * CELL)
    assert (g.scales[:, 2] < STRUCTURED_LIGHT.compute_sigma(np.float32(2.0))).all()
    local_z = quats_to_rotations(g.quats_wxyz.astype(float))[:, :, 2]
    np.testing.assert_allclose(np.abs(local_z @ T[:3, 2]), 1, atol=1e-5)
    np.testing.assert_allclose(transform(T, g.anchor_cam.astype(float)), g.means, atol=1e-5)


def test_far_measurements_that_lie_wider_apart_than_cells_get_wider_gaussians() -> None:
    near, far = (lifted([wall_frame(d)], [np.eye(4)], min_pixels=1) for d in (1.0, 9.0))
    assert near.scales[:, 0].max() == pytest.approx(0.7 * CELL)
    assert np.median(far.scales[:, 0]) == pytest.approx(0.7 * 9.0 / CAMERA.fx, rel=1e-3)


@pytest.mark.parametrize("finer", [1.0, 0.7, 0.5])
def test_at_the_default_coverage_a_wall_reaches_one_half_at_six_tenths_of_a_voxel(finer: float) -> None:
    """Whatever the cells: finer ones hold more Gaussians, each of which says less on the lattice."""
    V = 2 * CELL
    g = lifted([wall_frame(2.0 + 0.5 * CELL)], [np.eye(4)], cell=finer * CELL, initialization="ray_aligned")
    least, paper = (
        anchors.compute_least_scale(anchors.Options(), finer * CELL, V),
        splat.Options(projection="probabilistic"),
    )
    wall = float(g.means[0, 2])
    x, y = (np.random.default_rng(0).uniform(-0.5, 0.5, 200) for _ in range(2))
    points = {offset: np.stack((x, y, np.full(200, wall + offset * V)), axis=1) for offset in (0.0, 0.6, 1.0)}
    alpha = {
        offset: splat_reference.compute_probability_reference(g, at, paper, least).mean()
        for offset, at in points.items()
    }
    assert alpha[0.0] > 0.9
    assert alpha[0.6] == pytest.approx(0.5, abs=0.05)
    assert alpha[1.0] < 0.05


def test_reanchored_gaussians_follow_their_keyframes_exactly() -> None:
    frames, old = [wall_frame(2.0, 0), wall_frame(1.5, 1)], np.stack((random_pose(0), random_pose(1)))
    g = lifted(frames, old)
    moves = [random_pose(10), random_pose(11)]
    new = np.stack([move @ T for move, T in zip(moves, old, strict=True)])
    moved = anchors.reanchor(g, old, new)
    for k, move in enumerate(moves):
        own = g.anchor_keyframe == k
        np.testing.assert_allclose(moved.means[own], transform(move, g.means[own].astype(float)), atol=1e-4)
        expected = move[:3, :3] @ quats_to_rotations(g.quats_wxyz[own].astype(float))
        np.testing.assert_allclose(quats_to_rotations(moved.quats_wxyz[own].astype(float)), expected, atol=1e-5)
    np.testing.assert_array_equal(moved.anchor_cam, g.anchor_cam)


def test_aligned_moves_means_scales_and_rotations_as_the_paper_says() -> None:
    g = lifted([wall_frame(2.0)], [random_pose(0)])
    T = random_pose(5)
    moved = anchors.align_gaussians(g, 2.0, T[:3, :3], T[:3, 3])
    np.testing.assert_allclose(moved.means, 2.0 * g.means @ T[:3, :3].T + T[:3, 3], atol=1e-4)
    np.testing.assert_allclose(moved.scales, 2.0 * g.scales)
    covariance = T[:3, :3] @ quats_to_rotations(g.quats_wxyz.astype(float))
    np.testing.assert_allclose(quats_to_rotations(moved.quats_wxyz.astype(float)), covariance, atol=1e-5)


def test_pixels_at_depth_edges_are_dropped() -> None:
    depth = np.full((20, 20), 2.0, np.float32)
    depth[:, 10:] = 3.0
    depth[3, 3] = 0
    good = depth_edges.mask_away_from_edges(depth, 0.05)
    assert not good[:, 9:11].any()
    assert not good[3, 3]
    assert good[:3, :9].all()
    assert good[:, 11:].all()


def test_the_compiled_edge_test_agrees_with_plain_numpy() -> None:
    depth = np.random.default_rng(0).uniform(2.0, 2.2, (30, 40)).astype(np.float32)
    depth[np.random.default_rng(1).uniform(size=depth.shape) < 0.2] = 0
    compiled = [
        [depth[v, u] > 0 and not depth_edges.is_at_edge(depth, v, u, 0.05) for u in range(40)] for v in range(30)
    ]
    np.testing.assert_array_equal(compiled, depth_edges.mask_away_from_edges(depth, 0.05))


def test_cells_smaller_than_the_pixels_spacing_keep_the_surface() -> None:
    # 15 mm between pixels, cells of 5 mm: every pixel stays, as a Gaussian as wide as the spacing.
    g = lifted([wall_frame(2.0)], [np.eye(4)], cell=0.005)
    assert len(g) > 0.95 * CAMERA.width * CAMERA.height
    assert g.scales[:, 0].min() == pytest.approx(0.7 * 2.0 / CAMERA.fx, rel=1e-3)


def test_every_pixel_counts_whose_depth_says_how_uncertain_it_is() -> None:
    wide = Intrinsics(640, 480, 520.0, 520.0, 319.5, 239.5)
    frame = wall_frame(2.0, camera=wide)
    assert anchors.choose_stride(frame, anchors.Options(), CELL) == 2
    assert anchors.choose_stride(with_sigma(frame), anchors.Options(), CELL) == 1
    assert anchors.choose_stride(with_sigma(frame), anchors.Options(pixel_stride=3), CELL) == 3


def test_a_frame_without_depth_adds_nothing() -> None:
    frame = wall_frame(2.0)
    empty = Frame(0, 0.0, frame.color, np.zeros_like(frame.depth_m), CAMERA)
    assert len(lifted([empty], [np.eye(4)])) == 0
    g = lifted([empty, frame], [np.eye(4)] * 2)
    assert set(g.anchor_keyframe) == {1}


def test_order_of_keyframes_changes_nothing_but_their_numbers() -> None:
    frames, poses = [wall_frame(2.0, i, seed=i) for i in range(3)], [np.eye(4)] * 3
    forward, backward = lifted(frames, poses), lifted(frames[::-1], poses)
    np.testing.assert_allclose(forward.means, backward.means, atol=1e-6)
