"""Words of descriptors, and how alike pictures are that share some of them."""

from __future__ import annotations

import numpy as np

from freeocc3d.tracking.rgbd.place_recognition import Vocabulary, compare_histograms


def around(centers: np.ndarray, count: int, bits: int, seed: int) -> np.ndarray:
    """Descriptors that differ from centers (C, 32) in a few bits: ``count`` in a row for each."""
    rng = np.random.default_rng(seed)
    many = np.unpackbits(np.repeat(centers, count, axis=0), axis=1)
    for row in many:
        row[rng.choice(256, bits, replace=False)] ^= 1
    return np.packbits(many, axis=1)


def test_each_word_is_a_cluster_of_descriptors() -> None:
    centers = np.random.default_rng(0).integers(0, 256, (20, 32), dtype=np.uint8)
    vocabulary = Vocabulary([around(centers[:8], 200, 20, 1), around(centers[8:], 200, 20, 2)])
    words = [vocabulary.histogram(around(centers[n : n + 1], 60, 20, 100 + n)) for n in range(20)]
    shared = (np.stack(words) > 0).sum(axis=0)
    assert shared.max() == 1, "no word stands for two clusters"
    assert all(word.sum() == 60 for word in words)
    again = vocabulary.histogram(around(centers, 3, 0, 0))
    assert again.sum() == 60
    assert len(np.flatnonzero(again)) == 20
    assert (again[again > 0] == 3).all()


def test_similarity_is_the_cosine_of_roots_in_which_rare_words_count_more() -> None:
    histograms = np.float32([(4, 1, 0, 0), (1, 0, 9, 0), (0, 0, 0, 0), (4, 1, 0, 0)])
    weights = np.log(1 + 4 / np.array((3, 2, 1, 1)))
    vectors = np.sqrt(histograms) * weights
    lengths = np.linalg.norm(vectors, axis=1)
    wanted = vectors @ vectors.T / np.where(lengths > 0, lengths, 1) / np.where(lengths > 0, lengths, 1)[:, None]
    np.testing.assert_allclose(compare_histograms(histograms), wanted, rtol=1e-5, atol=1e-7)
