"""8-bit features."""

import numpy as np

from freeocc3d.language.codec import Codec


def unit_features(n: int, d: int, seed: int) -> np.ndarray:
    x = np.random.default_rng(seed).normal(size=(n, d))
    return (x / np.linalg.norm(x, axis=1, keepdims=True)).astype(np.float16)


def test_decoded_features_are_close_and_unit() -> None:
    for d in (16, 512):
        features = unit_features(2000, d, seed=d)
        decoded = Codec.fit(features).decode(Codec.fit(features).encode(features)).astype(float)
        assert (features.astype(float) * decoded).sum(axis=1).mean() > 0.999
        np.testing.assert_allclose(np.linalg.norm(decoded, axis=1), 1.0, atol=2e-3)


def test_unknown_stays_exactly_unknown() -> None:
    features = unit_features(100, 8, seed=1)
    features[::3] = 0
    codec = Codec.fit(features)
    codes = codec.encode(features)
    assert codes.dtype == np.uint8
    decoded = codec.decode(codes)
    assert not decoded[::3].any()
    assert decoded[1::3].any(axis=1).all()


def test_one_hot_features_come_back_as_such() -> None:
    features = np.eye(12, dtype=np.float16)
    np.testing.assert_allclose(Codec.fit(features).decode(Codec.fit(features).encode(features)), features, atol=1e-3)


def test_tables_restore_the_codec_and_empty_input_is_fine() -> None:
    features = unit_features(10, 4, seed=2)
    codec = Codec.fit(features)
    again = Codec.from_tables(codec.tables())
    np.testing.assert_array_equal(again.decode(codec.encode(features)), codec.decode(codec.encode(features)))
    empty = np.zeros((0, 4), np.float16)
    assert Codec.fit(empty).decode(Codec.fit(empty).encode(empty)).shape == (0, 4)
