"""Coded features: the loss in cosine, what stays exact, and scores without decoding."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from small_captures import data_folder

from freeocc3d.language import feature_codec as codec_module
from freeocc3d.language.feature_codec import Codec, CodedFeatures


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


@pytest.mark.parametrize(
    "features", [random_features(), membership_features(), unit(np.eye(40)), random_features(dimension=512)]
)
def test_decoded_features_are_unit_and_nearly_the_same(features: NDArray[np.float16]) -> None:
    codec = Codec.fit(features)
    codes = codec.encode(features)
    decoded = codec.decode(codes)
    assert codes.dtype == np.uint8
    assert codes.shape == (len(features), codec.code_bytes)
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


def test_normalized_means_outside_of_the_fitted_range_survive() -> None:
    """Features of voxels are normalized means of the features that the codec was fitted to."""
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


@pytest.mark.parametrize("dimension", [32, 512])
@pytest.mark.parametrize("many", [False, True])
def test_cosines_are_those_of_decoded_features(dimension: int, many: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    features = random_features(dimension=dimension)
    features[:10] = 0
    text = random_features(5, dimension, seed=1).astype(np.float32)
    codec = Codec.fit(features)
    codes = codec.encode(features)
    expected = codec.decode(codes).astype(np.float32) @ text.T
    monkeypatch.setattr(codec_module, "MANY", 0 if many else 10**9)
    found = codec.cosines(codes, text)
    np.testing.assert_allclose(found, expected, atol=2e-3)
    assert not found[:10].any()
    coded = CodedFeatures(codec, codes)
    np.testing.assert_array_equal(codec_module.compute_cosines(coded[5:50], text), codec.cosines(codes[5:50], text))
    np.testing.assert_array_equal(codec_module.mask_known(coded), features.any(axis=1))
    np.testing.assert_array_equal(np.asarray(coded), codec.decode(codes))
    assert coded.shape == features.shape


def smooth_fields(length: float, n: int = 20000, dimension: int = 512) -> NDArray[np.float16]:
    """Features that change over the walls of a room of 4 m, by their correlation length in meters."""
    rng = np.random.default_rng(0)
    points = rng.uniform(0, 4, (n, 3))
    wall = rng.integers(0, 3, n)
    points[np.arange(n), wall] = 4 * rng.integers(0, 2, n)
    waves = rng.normal(size=(3, dimension)) / length
    return unit(np.cos(points @ waves + rng.uniform(0, 2 * np.pi, dimension)))


@pytest.mark.parametrize(("length", "mean"), [(2.0, 0.999), (1.0, 0.995), (0.7, 0.98)])
def test_smooth_fields_of_512_dimensions_fit_in_48_bytes(length: float, mean: float) -> None:
    features = smooth_fields(length)
    codec = Codec.fit(features)
    assert codec.code_bytes == 48
    assert cosines(codec.decode(codec.encode(features)), features).mean() >= mean


def test_words_name_the_same_voxels_after_coding() -> None:
    """Posteriors of a real network's kind, mixed with real text embeddings."""
    file = np.load(data_folder().parent / "models" / "clip_text_names.npz")
    embeddings = file["embeddings"].astype(np.float32)
    rng = np.random.default_rng(0)
    things = embeddings[rng.choice(len(embeddings), 40, replace=False)]
    features = unit(rng.dirichlet(np.full(40, 0.05), 20000) @ things)
    words = np.concatenate((things[::4], embeddings[:10]))
    codec = Codec.fit(features)
    codes = codec.encode(features)
    assert cosines(codec.decode(codes), features).mean() >= 0.999
    same = codec.cosines(codes, words).argmax(axis=1) == (features.astype(np.float32) @ words.T).argmax(axis=1)
    assert same.mean() >= 0.99


def test_tables_that_do_not_belong_together_are_refused() -> None:
    tables = Codec.fit(random_features(dimension=100)).tables()
    with pytest.raises(ValueError, match="do not belong together"):
        Codec.from_tables(tables | {"offset": tables["offset"][1:]})
    with pytest.raises(ValueError, match="do not belong together"):
        Codec.from_tables(tables | {"bits": tables["bits"][::-1]})


def test_the_size_of_chunks_does_not_show(monkeypatch: pytest.MonkeyPatch) -> None:
    features = random_features()
    codec = Codec.fit(features)
    codes = codec.encode(features)
    monkeypatch.setattr(codec_module, "_ROWS", 7)
    chunked = Codec.fit(features)
    np.testing.assert_array_equal(chunked.offset, codec.offset)
    np.testing.assert_array_equal(chunked.encode(features), codes)
    np.testing.assert_array_equal(chunked.decode(codes), codec.decode(codes))


@pytest.mark.parametrize("features", [membership_features(), random_features(dimension=512)])
def test_norms_that_are_kept_give_the_same_cosines(features: NDArray[np.float16]) -> None:
    features[::5] = 0
    codec = Codec.fit(features)
    codes, text = codec.encode(features), features[1:4].astype(np.float32)
    inverse = codec.inverse_norms(codes)
    lengths = np.linalg.norm((codec._levels(codes) * codec.scale + codec.offset)[features.any(axis=1)], axis=1)
    np.testing.assert_allclose(inverse[features.any(axis=1)], 1 / lengths, rtol=1e-5)
    assert not inverse[::5].any()
    np.testing.assert_allclose(codec.cosines(codes, text, inverse), codec.cosines(codes, text), atol=1e-6)


@pytest.mark.parametrize(("rows", "words"), [(5000, 1), (5000, 300), (3, 7), (0, 5), (10, 0)])
def test_products_in_tiles_are_products(rows: int, words: int) -> None:
    rng = np.random.default_rng(0)
    a, b = rng.random((rows, 48)).astype(np.float32), rng.random((48, words)).astype(np.float32)
    np.testing.assert_allclose(codec_module._product(a, b), a @ b, rtol=1e-4)
    assert codec_module._product(a[:, :0], b[:0]).shape == (rows, words)
