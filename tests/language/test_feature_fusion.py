"""Fusion of features over views: the compiled kernels against NumPy, and what is left out."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from freeocc3d.language import feature_fusion
from freeocc3d.language.feature_fusion import FeatureFusion
from freeocc3d.language.visibility import VisibleGaussians

SHAPE = 12, 16
WALL, VASE = np.eye(8)[0], np.eye(8)[1]


def unit(shape: tuple[int, ...], seed: int = 0) -> NDArray[np.float16]:
    values = np.random.default_rng(seed).normal(size=shape)
    return (values / np.linalg.norm(values, axis=-1, keepdims=True)).astype(np.float16)


def view(rows: object, seed: int = 0, weights: object = None) -> VisibleGaussians:
    """A view of some Gaussians at random pixels."""
    rows, rng = np.asarray(rows, np.int32), np.random.default_rng(seed)
    weights = rng.random(len(rows)) + 0.1 if weights is None else np.broadcast_to(weights, len(rows))
    pixels = rng.integers(0, SHAPE[0] * SHAPE[1], len(rows)).astype(np.int32)
    return VisibleGaussians(rows, pixels, weights.astype(np.float32), SHAPE)


def half(columns: int, first: object, second: object) -> NDArray[np.float16]:
    """Features of an image whose first columns show one thing, and the rest another."""
    features = np.empty((*SHAPE, 8), np.float16)
    features[:, :columns], features[:, columns:] = first, second
    return features


def everywhere(count: int = SHAPE[0] * SHAPE[1]) -> VisibleGaussians:
    """A view that shows Gaussian n at pixel n, the first ``count`` of them."""
    numbers = np.arange(count, dtype=np.int32)
    return VisibleGaussians(numbers, numbers, np.ones(count, np.float32), SHAPE)


def test_the_sum_is_numpys() -> None:
    fused, total, weights = FeatureFusion(50, 6), np.zeros((50, 6)), np.zeros(50)
    for seed in range(5):
        seen = view(np.sort(np.random.default_rng(seed).choice(50, 30, replace=False)), seed)
        features = (unit((4, 5, 6), seed) * np.random.default_rng(seed).random((4, 5, 1))).astype(np.float16)
        features[0, :2] = 0
        fused.add(seen, features)
        own = features.reshape(-1, 6)[seen.cells((4, 5))].astype(np.float64)
        total[seen.rows] += seen.weights[:, None] * own
        weights[seen.rows] += seen.weights * np.linalg.norm(own, axis=1)
    np.testing.assert_allclose(fused.sum, total, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(fused.weights, weights, rtol=1e-4, atol=1e-6)
    norms = np.linalg.norm(total, axis=1, keepdims=True)
    np.testing.assert_allclose(fused.features(), total / np.where(norms > 0, norms, 1), atol=2e-3)


def test_features_are_of_unit_length_and_zero_where_nothing_is_said() -> None:
    fused = FeatureFusion(2, 3)
    for value in ((1, 0, 0), (0, 1, 0), (0, 0, 0)):
        fused.add(view([0], weights=0.25), np.broadcast_to(np.float16(value), (2, 2, 3)))
    assert fused.features().dtype == np.float16
    np.testing.assert_allclose(fused.features(), [(np.sqrt(0.5), np.sqrt(0.5), 0), (0, 0, 0)], atol=1e-3)
    assert fused.weights[0] == pytest.approx(0.5, rel=1e-3)


def test_an_encoders_doubt_is_a_smaller_weight() -> None:
    fused = FeatureFusion(1, 8)
    fused.add(view([0], weights=1.0), half(8, WALL, WALL))
    fused.add(view([0], weights=1.0), 0.25 * half(8, VASE, VASE))
    np.testing.assert_allclose(fused.features()[0, 1] / fused.features()[0, 0], 0.25, rtol=1e-2)


@pytest.mark.parametrize("disagreement", [None, 0.6])
def test_order_of_views_matters_to_rounding_only(disagreement: float | None) -> None:
    views = [(view(np.arange(40 * (n % 3), 200), n), half(4 + n, WALL, unit((8,), n))) for n in range(8)]
    results = []
    for order in (views, views[::-1], views[3:] + views[:3]):
        fused = FeatureFusion(200, 8, disagreement)
        for seen, features in order:
            fused.add(seen, features)
        results.append(fused.features().astype(np.float32))
    assert results[0].any(axis=1).mean() > 0.3
    for other in results[1:]:
        np.testing.assert_allclose(results[0], other, atol=2e-3)


def test_views_in_a_file_say_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    found = []
    for room in (1 << 30, 0, 20):
        monkeypatch.setattr(feature_fusion, "_IN_MEMORY", room)
        fused = FeatureFusion(SHAPE[0] * SHAPE[1], 8, 0.5)
        for columns, other in ((0, WALL), (8, VASE), (16, WALL), (12, VASE)):
            fused.add(everywhere(), half(columns, other, VASE))
        found.append(fused.features())
        assert (fused._file is None) == (room == 1 << 30)
    np.testing.assert_array_equal(found[0], found[1])
    np.testing.assert_array_equal(found[0], found[2])


def test_asking_in_between_changes_nothing() -> None:
    views = [(view(np.arange(100), n), half(4 + n, WALL, unit((8,), n))) for n in range(6)]
    asked, silent = FeatureFusion(100, 8, 0.6), FeatureFusion(100, 8, 0.6)
    for seen, features in views:
        asked.add(seen, features)
        asked.features()
        silent.add(seen, features)
    np.testing.assert_allclose(asked.features(), silent.features(), atol=2e-3)


@pytest.mark.parametrize("seen_again", [150, 60])
def test_a_region_that_others_contradict_is_left_out_with_what_it_alone_shows(seen_again: int) -> None:
    """Three views of a part of a wall; one more, of all of it, takes it for a vase where it is not something else."""
    whole, most = everywhere(), everywhere(seen_again)
    fused, plain = FeatureFusion(len(whole.rows), 8, 0.6), FeatureFusion(len(whole.rows), 8)
    for into in (fused, plain):
        for _ in range(3):
            into.add(most, half(8, WALL, np.eye(8)[2]))
        into.add(whole, half(8, VASE, np.eye(8)[2]))
    left = np.arange(len(whole.rows)) % SHAPE[1] < 8
    once = np.arange(len(whole.rows)) >= seen_again
    assert plain.features()[left & once, 1].all()  # the vase, for all that a mean knows
    found = fused.features()
    np.testing.assert_allclose(found[left & ~once], np.broadcast_to(WALL, (np.sum(left & ~once), 8)), atol=1e-2)
    assert not found[left & once].any()
    assert (found[~left, 2] > 0.99).all()  # the rest of that view stays, also where it is alone


def test_where_all_views_contradict_each_other_what_is_said_most_stays() -> None:
    """A thing that two views see as it is, and three others each take for something else."""
    floor, *mistakes = np.eye(8)[2:6]
    for order in np.random.default_rng(0).permuted(np.tile(np.arange(5), (6, 1)), axis=1):
        fused = FeatureFusion(192, 8, 0.6)
        for n in order:
            fused.add(everywhere(), half(4, [VASE, VASE, *mistakes][n], floor))
        left = np.arange(192) % SHAPE[1] < 4
        np.testing.assert_allclose(fused.features()[left], np.broadcast_to(VASE, (48, 8)), atol=1e-2)


def test_two_views_that_contradict_each_other_count_alike() -> None:
    fused = FeatureFusion(192, 8, 0.6)
    for thing in (WALL, VASE):
        fused.add(everywhere(), half(16, thing, thing))
    np.testing.assert_allclose(fused.features()[:, :2], np.sqrt(0.5), atol=1e-2)


def test_differences_count_relative_to_the_scenes_own() -> None:
    """Features as CLIP's, all alike: the outlier is found at a cosine of 0.8 as it is at 0."""
    common = 2 * np.eye(8)[7]
    wall, vase, floor = ((thing + common) / np.sqrt(5) for thing in (WALL, VASE, np.eye(8)[2]))
    fused = FeatureFusion(192, 8, 0.6)
    for first in (wall, wall, vase, wall):
        fused.add(everywhere(), half(8, first, floor))
    left = np.arange(192) % SHAPE[1] < 8
    np.testing.assert_allclose(fused.features()[left], np.broadcast_to(wall, (96, 8)), atol=1e-2)


def test_what_one_view_alone_shows_is_kept() -> None:
    fused = FeatureFusion(192, 8, 0.6)
    fused.add(everywhere(), half(8, WALL, VASE))
    assert fused.features().any(axis=1).all()


def test_regions_are_connected_and_alike() -> None:
    features = np.zeros((3, 4, 2), np.float32)
    features[0, :2] = features[2, 3] = features[1, 0] = (1, 0)
    features[0, 2:] = (0, 1)
    first, shared = feature_fusion._regions(features, np.float32(0.9), np.float32(0.999))
    a, b, c = 0, 2, 11
    zeros = [5, 6, 7, 8, 9, 10]
    np.testing.assert_array_equal(first, [a, a, b, b, a, *zeros, c])
    np.testing.assert_array_equal(shared, first)
    features[0, 1] = (1, 0.2)  # like its neighbor, but not the same
    first, shared = feature_fusion._regions(features, np.float32(0.9), np.float32(0.999))
    assert (first[1], shared[1]) == (0, 1)


def test_codes_keep_features_to_less_than_a_percent() -> None:
    features = unit((100, 512)).astype(np.float32)
    codes, scales = feature_fusion._coded(features, np.arange(0, 100, 2))
    decoded = codes * scales[:, None]
    np.testing.assert_allclose(np.linalg.norm(decoded, axis=1), 1, rtol=1e-4)
    assert (decoded * features[::2]).sum(axis=1).min() > 0.999


def test_halves_are_widened_exactly() -> None:
    finite = np.arange(1 << 16, dtype=np.uint16).view(np.float16)
    finite = finite[np.isfinite(finite)][None, None]
    np.testing.assert_array_equal(feature_fusion._widened(finite.view(np.uint16)), finite.astype(np.float32))


def test_agreement_is_numpys_leave_one_out_cosine() -> None:
    rng = np.random.default_rng(0)
    total, weights = rng.normal(size=(30, 16)).astype(np.float32), np.full(30, 2.0, np.float32)
    codes, scales = feature_fusion._coded(rng.normal(size=(5, 16)).astype(np.float32), np.arange(5))
    rows, slots = np.arange(0, 30, 2, dtype=np.int32), rng.integers(0, 5, 15).astype(np.int32)
    own = np.where(rows > 20, np.float32(2), np.float32(0.5))
    found = feature_fusion._agreement(rows, slots, own, codes, scales, total, weights)
    feature = codes[slots] * scales[slots, None]
    other = total[rows] - own[:, None] * feature
    expected = (feature * other).sum(axis=1) / np.linalg.norm(other, axis=1)
    np.testing.assert_allclose(found, np.where(rows > 20, np.nan, expected), rtol=1e-4, atol=1e-5)


def test_no_gaussians() -> None:
    fused = FeatureFusion(0, 3, 0.6)
    fused.add(view([]), unit((6, 8, 3)))
    assert fused.features().shape == (0, 3)
