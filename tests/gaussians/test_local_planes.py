"""Planes of neighbors: the kernel against plain NumPy, noise that they take away, and what they leave alone."""

import numpy as np
from scipy.spatial import cKDTree

from freeocc3d.gaussians import local_planes
from freeocc3d.gaussians.local_planes import fit_planes


def fit_reference(points, sigma_m, rays, spacing):
    """The equations of ``local_planes`` for one point after the other."""
    sigma_m = np.hypot(sigma_m, 1e-3)
    rays = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    neighbors = cKDTree(points).query(points, k=min(32, len(points)))[1]
    moved, normals, sigma = points.copy(), -rays, sigma_m.copy()
    for i, near in enumerate(neighbors):
        place = points[near] - points[i]
        squared = (place**2).sum(axis=1)
        used = (rays[near] @ rays[i] >= 0) & (squared <= (3 * spacing[i]) ** 2)
        if used.sum() < 4:
            continue
        place, squared = place[used], squared[used]
        variance = sigma_m[near][used] ** 2 + (0.15 * squared**0.5) ** 2
        near_weight = np.exp(-0.5 * squared / (1.25 * spacing[i]) ** 2) / variance
        weight, mean, normal = near_weight, np.zeros(3), np.zeros(3)
        for turn in range(3):
            if turn > 0:
                weight = near_weight / (1 + ((place - mean) @ normal) ** 2 / (4 * variance)) ** 2
            mean = weight @ place / weight.sum()
            values, axes = np.linalg.eigh((place.T * weight) @ place / weight.sum() - np.outer(mean, mean))
            normal = axes[:, 0]
        noise = weight @ sigma_m[near][used] ** 2 / weight.sum()
        own, plane = sigma_m[i] ** 2, 1 / weight.sum() + max(values[0] - noise, 0)
        moved[i] += own / (own + plane) * (normal @ mean) * normal
        normals[i] = normal * (-1 if normal @ rays[i] > 0 else 1)
        sigma[i] = (own / (1 + own * weight.sum())) ** 0.5
    return moved, normals, sigma


def wall(count: int, noise_m: float, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.column_stack((rng.uniform(-0.5, 0.5, (count, 2)), 2 + rng.normal(0, noise_m, count)))


def test_the_kernel_agrees_with_plain_numpy() -> None:
    rng = np.random.default_rng(3)
    points = np.concatenate((wall(200, 0.01), wall(100, 0.02)[:, [2, 0, 1]], rng.uniform(-1, 3, (30, 3))))
    sigma, spacing = rng.uniform(0.001, 0.03, len(points)), rng.uniform(0.03, 0.08, len(points))
    rays = points - (0, 0, -1)
    found = fit_planes(points, sigma, rays, spacing)
    moved, normals, uncertain = fit_reference(points, sigma, rays, spacing)
    np.testing.assert_allclose(found.points, moved, atol=1e-9)
    np.testing.assert_allclose(found.sigma_m, uncertain, rtol=1e-9)
    assert (np.abs((found.normals * normals).sum(axis=1)) > 1 - 1e-6).all()
    assert ((found.normals * rays).sum(axis=1) < 1e-9).all()
    assert np.count_nonzero((found.points != points).any(axis=1)) > 250


def test_an_uncertain_wall_gets_flat_and_knows_that_it_is() -> None:
    points = wall(900, 0.02)
    found = fit_planes(points, np.full(900, 0.02), points, np.full(900, 0.033))
    assert np.std(found.points[:, 2]) < 0.65 * np.std(points[:, 2])
    assert np.median(np.abs(found.normals[:, 2])) > 0.98
    assert (found.sigma_m < 0.015).all()


def test_what_is_measured_well_stays_where_it_is() -> None:
    points = wall(900, 0.02)  # not noise: its measurements are sure of it
    found = fit_planes(points, np.full(900, 0.0002), points, np.full(900, 0.033))
    assert np.abs(found.points - points).max() < 0.004


def test_the_two_sides_of_a_board_do_not_mix() -> None:
    front, back = wall(900, 0.0), wall(900, 0.0, 1) + (0, 0, 0.02)
    points, rays = np.concatenate((front, back)), np.repeat(((0, 0, 1.0), (0, 0, -1.0)), 900, axis=0)
    found = fit_planes(points, np.full(1800, 0.01), rays, np.full(1800, 0.033))
    np.testing.assert_allclose(found.points, points, atol=1e-9)
    np.testing.assert_allclose(found.normals, -rays, atol=1e-6)


def test_few_points_have_no_plane_and_face_the_camera() -> None:
    for count in (0, 1, 3):
        points = wall(count, 0.01)
        found = fit_planes(points, np.full(count, 0.01), points, np.full(count, 1.0))
        np.testing.assert_array_equal(found.points, points)
        np.testing.assert_allclose(found.normals, -points / np.linalg.norm(points, axis=1, keepdims=True))


def test_the_least_axis_of_a_flat_a_round_and_an_empty_spread() -> None:
    axis = np.zeros(3)
    for S, least in (((1, 0, 0, 1, 0, 0), 0.0), ((1, 0, 0, 1, 0, 1), 1.0), ((0, 0, 0, 0, 0, 0), 0.0)):
        found = local_planes._least_axis(np.array(S, float), axis)
        assert abs(found - least) < 1e-12
        assert abs(np.linalg.norm(axis) - 1) < 1e-12
