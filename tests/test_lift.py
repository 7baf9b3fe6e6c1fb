"""Lifting features onto Gaussians against its plain reference; visibility; fusion."""

import numpy as np
from scenes import CAMERA, gaussians, random_gaussians, wall_frame

from freeocc3d.geometry import quats_to_rotations
from freeocc3d.language import lift
from freeocc3d.types import Frame


def random_view(seed: int, dimension: int = 5):
    rng = np.random.default_rng(seed)
    quat = np.array([1, 0, 0, 0]) + rng.normal(0, 0.1, 4)
    T = np.eye(4)
    T[:3, :3] = quats_to_rotations(quat / np.linalg.norm(quat))
    T[:3, 3] = rng.normal(0, 0.1, 3) - (0, 0, 2)
    depth = rng.uniform(1.5, 2.5, (CAMERA.height, CAMERA.width)).astype(np.float32)
    depth[rng.random(depth.shape) < 0.1] = 0
    features = rng.normal(size=(15, 20, dimension))
    features /= np.linalg.norm(features, axis=-1, keepdims=True)
    features[rng.random(features.shape[:2]) < 0.1] = 0
    frame = Frame(seed, float(seed), np.zeros((*depth.shape, 3), np.uint8), depth, CAMERA)
    return frame, T, features.astype(np.float16)


def test_one_view_equals_the_reference() -> None:
    g, options = random_gaussians(3000, seed=0, extent=1.5), lift.Options()
    frame, T, features = random_view(1)
    fusion = lift.FeatureFusion(len(g), 5, options)
    fusion.add(g, frame, T, features)
    total, weight = lift.fuse_reference(g, frame, T, features, options)
    assert 100 < (weight > 0).sum() < len(g)
    same = np.isclose(fusion.weight, weight, rtol=1e-4)
    assert same.mean() > 0.995  # a Gaussian on a pixel's border may round to either side
    np.testing.assert_allclose(fusion.sum[same], total[same], atol=2e-4)


def test_order_of_views_changes_nothing_but_rounding() -> None:
    g = random_gaussians(1000, seed=2, extent=1.5)
    results = []
    for order in ((1, 2, 3), (3, 1, 2)):
        fusion = lift.FeatureFusion(len(g), 5, lift.Options())
        for seed in order:
            fusion.add(g, *random_view(seed))
        results.append(fusion.features().astype(float))
    np.testing.assert_allclose(*results, atol=2e-3)


def test_what_is_hidden_gets_nothing_and_what_is_seen_gets_its_pixels_feature() -> None:
    g = gaussians([[0, 0, 2.0], [0, 0, 3.0], [-0.5, 0, 2.0], [0, 0, -1.0], [9, 0, 2.0]], 0.03)
    features = np.zeros((2, 2, 2), np.float16)
    features[:, 0, 0] = features[:, 1, 1] = 1
    fusion = lift.FeatureFusion(len(g), 2, lift.Options())
    fusion.add(g, wall_frame(2.0), np.eye(4), features)
    np.testing.assert_array_equal(fusion.features().astype(float), [[0, 1], [0, 0], [1, 0], [0, 0], [0, 0]])


def test_views_that_know_nothing_do_not_dilute() -> None:
    g = gaussians([[0, 0, 2.0]], 0.03)
    fusion = lift.FeatureFusion(1, 2, lift.Options())
    known = np.tile(np.float16([0.6, 0.8]), (2, 2, 1))
    fusion.add(g, wall_frame(2.0), np.eye(4), known)
    fusion.add(g, wall_frame(2.0), np.eye(4), np.zeros_like(known))
    np.testing.assert_allclose(fusion.features()[0].astype(float), [0.6, 0.8], atol=1e-3)
    assert fusion.weight[0] > 0


def test_near_views_count_more() -> None:
    g = gaussians([[0, 0, 0]], 0.03)
    fusion = lift.FeatureFusion(1, 2, lift.Options())
    for distance, feature in ((1.0, [1, 0]), (3.0, [0, 1])):
        T = np.eye(4)
        T[2, 3] = -distance
        fusion.add(g, wall_frame(distance), T, np.tile(np.float16(feature), (2, 2, 1)))
    np.testing.assert_allclose(fusion.sum[0], [1.0, 1 / 9], rtol=1e-3)
