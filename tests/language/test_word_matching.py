"""Scores relative to other words, and hysteresis."""

from __future__ import annotations

import numpy as np
import pytest

from freeocc3d.language import coded_scores, word_matching
from freeocc3d.occupancy.connected_components import label_components


def test_softmax_and_relevancy_are_those_of_their_definitions() -> None:
    rng = np.random.default_rng(0)
    scores, others = rng.random(50).astype(np.float32), rng.random((50, 4)).astype(np.float32)
    largest, odds = word_matching.compare_competitors(scores, others, 0.1)
    powers, own = np.exp(others / 0.1), np.exp(scores / 0.1)
    np.testing.assert_allclose(word_matching.compare_with_all(odds), own / (own + powers.sum(axis=1)), rtol=1e-3)
    pairwise = own[:, None] / (own[:, None] + powers)
    np.testing.assert_allclose(word_matching.compare_with_best(largest, 0.1), pairwise.min(axis=1), rtol=1e-3)


def test_extreme_margins_are_finite() -> None:
    assert word_matching.compare_with_best(np.float32([-2, 2]), 1e-3).tolist() == pytest.approx([1, 0], abs=1e-6)


@pytest.mark.parametrize("words", [0, 1, 7])
def test_compiled_code_agrees(words: int, monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(1)
    scores, others = rng.random(1000).astype(np.float32), rng.random((1000, words)).astype(np.float32)
    monkeypatch.setattr(word_matching, "is_worth_compiling", lambda count: False)
    expected = word_matching.compare_competitors(scores, others, 0.1)
    found = coded_scores.compare_coded_competitors(scores, np.asfortranarray(others).T, np.float32(10))
    for a, b in zip(found, expected, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-3)


@pytest.mark.parametrize("words", [0, 1, 7])
def test_confidences_are_softmax_where_nothing_scores_higher(words: int, monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(2)
    scores, others = rng.random((1000, 3)).astype(np.float32), (0.9 * rng.random((1000, words))).astype(np.float32)
    candidates, competes = rng.random((1000, 3)) < 0.8, rng.random((3, words)) < 0.7
    found = coded_scores.compute_coded_confidences(
        scores, np.asfortranarray(others), candidates, competes, np.float32(10)
    )
    monkeypatch.setattr(word_matching, "is_worth_compiling", lambda count: False)
    np.testing.assert_allclose(
        found, word_matching.compute_confidences(scores, others, candidates, competes, 0.1), rtol=1e-3
    )
    for w in range(3):
        largest, odds = word_matching.compare_competitors(scores[:, w], others[:, competes[w]], 0.1)
        expected = np.where(candidates[:, w] & (largest <= 0), word_matching.compare_with_all(odds), 0)
        np.testing.assert_allclose(found[:, w], expected, rtol=1e-3)


def test_only_what_is_connected_to_a_seed_grows() -> None:
    voxels = np.array([(0, 0, 0), (1, 1, 1), (2, 2, 2), (9, 0, 0), (9, 0, 1)], np.int32)
    seeds = np.array([False, False, True, False, False])
    assert word_matching.grow_regions(seeds, label_components(voxels)).tolist() == [True, True, True, False, False]
    assert not word_matching.grow_regions(np.zeros(5, bool), label_components(voxels)).any()
    assert word_matching.grow_regions(np.ones(5, bool), label_components(voxels)).all()
