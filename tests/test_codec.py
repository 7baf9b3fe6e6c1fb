"""8-bit features: how much a cosine loses, and what stays exact."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from freeocc3d.language import codec as codec_module
from freeocc3d.language.codec import Codec


def unit(rows: NDArray[np.floating]) -> NDArray[np.float16]:
    return (rows / np.linalg.norm(rows, axis=1, keepdims=True)).astype(np.float16)


def random_features(n: int = 2000, dimension: int = 32, seed: int = 0) -> NDArray[np.float16]:
    """Unit features of a few things and their mixtures, with a few dimensions that are large in all, as CLIP has."""
    rng = np.random.default_rng(seed)
    things = rng.normal(size=(20, dimension))
    things[:, :2] += 8
    return unit(rng.dirichlet(np.full(20, 0.3), n) @ things)


def membership_features(n: int = 2000, dimension: int = 25, seed: int = 0) -> NDArray[np.float16]:
    rng = np.random.default_rng(seed)
    return np.sqrt(rng.dirichlet(np.full(dimension, 0.1), n)).astype(np.float16)


def cosines(a: NDArray[np.floating], b: NDArray[np.floating]) -> NDArray[np.float64]:
    a, b = a.astype(np.float64), b.astype(np.float64)
    return (a * b).sum(axis=1) / np.linalg.norm(a, axis=1) / np.linalg.norm(b, axis=1)


@pytest.mark.parametrize("features", [random_features(), membership_features(), unit(np.eye(40))])
def test_decoded_features_are_unit_and_nearly_the_same(features: NDArray[np.float16]) -> None:
    codec = Codec.fit(features)
    codes = codec.encode(features)
    decoded = codec.decode(codes)
    assert codes.dtype == np.uint8
    assert codes.shape == features.shape
    assert decoded.dtype == np.float16
    np.testing.assert_allclose(np.linalg.norm(decoded.astype(np.float64), axis=1), 1, atol=2e-3)
    assert cosines(decoded, features).mean() >= 0.999
    assert cosines(decoded, features).min() >= 0.998


def test_unknown_stays_exactly_zero_and_known_never_becomes_it() -> None:
    features = random_features()
    features[::3] = 0
    decoded = Codec.fit(features).decode(Codec.fit(features).encode(features))
    np.testing.assert_array_equal(decoded.any(axis=1), features.any(axis=1))


def test_a_component_that_is_never_negative_decodes_to_exact_zeros() -> None:
    features = unit(np.eye(10))
    np.testing.assert_array_equal(Codec.fit(features).decode(Codec.fit(features).encode(features)), features)


def test_normalised_means_outside_of_the_fitted_range_survive() -> None:
    """Features of voxels are normalised means of the features that the codec was fitted to."""
    codec = Codec.fit(unit(np.array([(0.9, 0.43, 0.0), (0.9, 0.0, 0.43)])))
    mean = unit(np.array([(0.9, 0.215, 0.215)]))
    assert cosines(codec.decode(codec.encode(mean)), mean)[0] > 0.9999


@pytest.mark.parametrize("features", [np.zeros((0, 7), np.float16), np.zeros((5, 7), np.float16)])
def test_without_any_feature(features: NDArray[np.float16]) -> None:
    codec = Codec.fit(features)
    np.testing.assert_array_equal(codec.decode(codec.encode(features)), features)


def test_constant_dimension() -> None:
    features = unit(np.array([(1.0, 1.0), (1.0, 1.0)]))
    codec = Codec.fit(features)
    np.testing.assert_allclose(codec.decode(codec.encode(features)), features, atol=1e-3)


def test_tables_restore_the_codec() -> None:
    features = random_features()
    codec = Codec.fit(features)
    restored = Codec.from_tables(codec.tables())
    codes = codec.encode(features)
    np.testing.assert_array_equal(restored.encode(features), codes)
    np.testing.assert_array_equal(restored.decode(codes), codec.decode(codes))


def test_similarity_is_that_of_decoded_features() -> None:
    features = random_features()
    features[:10] = 0
    text = random_features(5, seed=1).astype(np.float32)
    codec = Codec.fit(features)
    codes = codec.encode(features)
    expected = codec.decode(codes).astype(np.float32) @ text.T
    np.testing.assert_allclose(codec.similarity(codes, text), expected, atol=2e-3)
    assert not codec.similarity(codes, text)[:10].any()


def test_the_size_of_chunks_does_not_show(monkeypatch: pytest.MonkeyPatch) -> None:
    features = random_features()
    codec = Codec.fit(features)
    codes = codec.encode(features)
    monkeypatch.setattr(codec_module, "_ROWS", 7)
    chunked = Codec.fit(features)
    np.testing.assert_array_equal(chunked.offset, codec.offset)
    np.testing.assert_array_equal(chunked.encode(features), codes)
    np.testing.assert_array_equal(chunked.decode(codes), codec.decode(codes))
