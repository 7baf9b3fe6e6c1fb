"""Fusion of image features: the compiled kernel against NumPy, and what is and is not seen."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scenes import CAMERA, gaussians, random_gaussians

from freeocc3d.errors import ConfigError
from freeocc3d.language.lift import FeatureFusion, Options, lift_reference
from freeocc3d.types import Frame


def frame(depth_m: object) -> Frame:
    shape = CAMERA.height, CAMERA.width
    depth = np.broadcast_to(np.asarray(depth_m, np.float32), shape).copy()
    return Frame(0, 0.0, np.zeros((*shape, 3), np.uint8), depth, CAMERA)


def pose(seed: int) -> NDArray[np.float64]:
    """A camera about two metres from the origin that looks at it, turned a little."""
    rng = np.random.default_rng(seed)
    U, _, Vt = np.linalg.svd(np.eye(3) + 0.2 * rng.normal(size=(3, 3)))
    T = np.eye(4)
    T[:3, :3] = U @ np.diag((1, 1, np.linalg.det(U @ Vt))) @ Vt
    T[:3, 3] = T[:3, :3] @ (0.1, -0.2, -2.0)
    return T


def unit(shape: tuple[int, ...], seed: int = 0) -> NDArray[np.float16]:
    values = np.random.default_rng(seed).normal(size=shape)
    return (values / np.linalg.norm(values, axis=-1, keepdims=True)).astype(np.float16)


def seen(z: float, depth_m: object, scale: float = 0.01, options: Options | None = None) -> bool:
    """Whether one Gaussian on the optical axis is seen in a depth image."""
    fusion = FeatureFusion(1, 3, options)
    fusion.add(gaussians((0.0, 0.0, z), scale), frame(depth_m), np.eye(4), unit((6, 8, 3)))
    return bool(fusion.weights[0] > 0)


def weight(z: float, depth_m: object) -> float:
    fusion = FeatureFusion(1, 3, Options(visible_within=10.0))
    fusion.add(gaussians((0.0, 0.0, z), 0.01), frame(depth_m), np.eye(4), unit((6, 8, 3)))
    return float(fusion.weights[0])


@pytest.mark.parametrize("seed", range(4))
def test_kernel_agrees_with_numpy(seed: int) -> None:
    rng = np.random.default_rng(seed)
    cloud = random_gaussians(3000, seed, extent=3.0)
    depth = 2.0 + rng.normal(0, 0.3, (CAMERA.height, CAMERA.width))
    depth[rng.random(depth.shape) < 0.2] = 0
    features = unit((31, 43, 9), seed)
    features[rng.random(features.shape[:2]) < 0.2] = 0
    options = Options(visible_within=0.3, visible_share=0.1)
    fusion = FeatureFusion(len(cloud), 9, options)
    fusion.add(cloud, frame(depth), pose(seed), features)
    total, weights = lift_reference(cloud, frame(depth), pose(seed), features, options)
    # float32 puts a few Gaussians on the other side of a pixel's border or of the tolerance
    agree = np.isclose(fusion.weights, weights, rtol=1e-3, atol=1e-6)
    assert 300 < np.count_nonzero(weights) < 2500
    assert agree.mean() > 0.995
    same = agree & np.isclose(fusion.sum, total, rtol=1e-2, atol=1e-4).all(axis=1)
    assert same.mean() > 0.995


def test_order_of_keyframes_matters_to_rounding_only() -> None:
    cloud = random_gaussians(500, 0)
    views = [(frame(2.0 + 0.02 * n), pose(n), unit((30, 40, 6), n)) for n in range(6)]
    results = []
    for order in (views, views[::-1]):
        fusion = FeatureFusion(len(cloud), 6, Options(visible_within=0.5))
        for image, T, features in order:
            fusion.add(cloud, image, T, features)
        results.append((fusion.features().astype(np.float32), fusion.weights))
    assert (results[0][1] > 0).mean() > 0.5
    np.testing.assert_allclose(results[0][0], results[1][0], atol=2e-3)
    np.testing.assert_allclose(results[0][1], results[1][1], rtol=1e-5)


def test_hidden_unmeasured_and_outside_are_not_seen() -> None:
    assert seen(2.0, 2.0)
    assert not seen(2.0, 1.5)  # behind what the image shows
    assert not seen(2.0, 2.5)  # before it: what the image shows was seen through the Gaussian
    assert not seen(2.0, 0.0)
    assert not seen(-2.0, 2.0)


def test_tolerance_grows_with_depth_and_with_the_gaussian() -> None:
    options = Options(visible_within=0.02, visible_share=0.01)
    assert seen(1.0, 1.025, 0.001, options)
    assert not seen(1.0, 1.045, 0.001, options)
    assert seen(4.0, 4.045, 0.001, options)
    assert seen(1.0, 1.045, 0.02, options)


def test_a_gaussians_extent_counts_along_the_ray_alone() -> None:
    flat = (0.5, 0.5, 0.001)
    for quat, expected in (((1, 0, 0, 0), False), ((np.sqrt(0.5), 0, np.sqrt(0.5), 0), True)):
        cloud = gaussians((0.0, 0.0, 2.0), flat, quats=quat)
        fusion = FeatureFusion(1, 3)
        fusion.add(cloud, frame(2.2), np.eye(4), unit((6, 8, 3)))
        assert bool(fusion.weights[0] > 0) == expected


def test_near_views_count_more() -> None:
    assert weight(1.0, 1.0) / weight(2.0, 2.0) == pytest.approx(4, rel=1e-3)
    assert weight(0.2, 0.2) == pytest.approx(weight(0.5, 0.5), rel=1e-3)


def test_views_along_the_surface_count_less() -> None:
    """A plane z = 2 + x tan(60°) is seen at 60° to its normal on the optical axis."""
    slope = (np.arange(CAMERA.width) - CAMERA.cx) / CAMERA.fx
    tilted = 2.0 / (1.0 - slope * np.tan(np.deg2rad(60)))
    assert weight(2.0, tilted[None]) / weight(2.0, 2.0) == pytest.approx(0.5, rel=0.05)


def test_feature_of_the_cell_that_the_gaussian_projects_to() -> None:
    """Pixel borders and cell borders, for images whose size is no multiple of the features'."""
    features = unit((7, 9, 5))
    pixels = np.array([(u, v) for u in (0, 17, 18, 80, 159) for v in (0, 17, 18, 119)], float)
    means = np.stack(((pixels[:, 0] - CAMERA.cx) / CAMERA.fx, (pixels[:, 1] - CAMERA.cy) / CAMERA.fy, np.ones(20)), 1)
    fusion = FeatureFusion(20, 5)
    fusion.add(gaussians(means, 0.01), frame(1.0), np.eye(4), features)
    rows, columns = (pixels[:, 1] * 7 // 120).astype(int), (pixels[:, 0] * 9 // 160).astype(int)
    np.testing.assert_allclose(fusion.features(), features[rows, columns], atol=2e-3)


def test_features_are_means_of_unit_length_and_zero_where_nothing_is_said() -> None:
    a, b = np.float16([1, 0, 0]), np.float16([0, 1, 0])
    cloud = gaussians([(0, 0, 2), (0, 0, 9)], 0.01)
    fusion = FeatureFusion(2, 3)
    for value in (a, b, np.zeros(3, np.float16)):
        fusion.add(cloud, frame(2.0), np.eye(4), np.broadcast_to(value, (6, 8, 3)))
    assert fusion.features().dtype == np.float16
    np.testing.assert_allclose(fusion.features(), [(np.sqrt(0.5), np.sqrt(0.5), 0), (0, 0, 0)], atol=1e-3)
    assert fusion.weights[0] == pytest.approx(2 / 4, rel=1e-3)


def test_no_gaussians() -> None:
    fusion = FeatureFusion(0, 3)
    fusion.add(random_gaussians(1, 0)[:0], frame(2.0), np.eye(4), unit((6, 8, 3)))
    assert fusion.features().shape == (0, 3)


@pytest.mark.parametrize("bad", [{"visible_within": 0.0}, {"near": 0.0}, {"visible_share": -0.1}])
def test_options_out_of_range_are_refused(bad: dict) -> None:
    with pytest.raises(ConfigError):
        Options(**bad)
