"""Scores beside other words, and hysteresis."""

from __future__ import annotations

import numpy as np
import pytest

from freeocc3d.language import matching, scoring
from freeocc3d.occupancy.connected import connected


def test_softmax_and_relevancy_are_those_of_their_definitions() -> None:
    rng = np.random.default_rng(0)
    scores, others = rng.random(50).astype(np.float32), rng.random((50, 4)).astype(np.float32)
    largest, odds = matching.beside(scores, others, 0.1)
    powers, own = np.exp(others / 0.1), np.exp(scores / 0.1)
    np.testing.assert_allclose(matching.softmax(odds), own / (own + powers.sum(axis=1)), rtol=1e-3)
    pairwise = own[:, None] / (own[:, None] + powers)
    np.testing.assert_allclose(matching.relevancy(largest, 0.1), pairwise.min(axis=1), rtol=1e-3)


def test_extreme_margins_are_finite() -> None:
    assert matching.relevancy(np.float32([-2, 2]), 1e-3).tolist() == pytest.approx([1, 0], abs=1e-6)


@pytest.mark.parametrize("words", [0, 1, 7])
def test_compiled_code_agrees(words: int, monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(1)
    scores, others = rng.random(1000).astype(np.float32), rng.random((1000, words)).astype(np.float32)
    monkeypatch.setattr(matching, "compiled", lambda count: False)
    expected = matching.beside(scores, others, 0.1)
    found = scoring.beside(scores, np.asfortranarray(others).T, np.float32(10))
    for a, b in zip(found, expected, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-3)


@pytest.mark.parametrize("words", [0, 1, 7])
def test_confidences_are_softmax_where_nothing_scores_higher(words: int, monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(2)
    scores, others = rng.random((1000, 3)).astype(np.float32), (0.9 * rng.random((1000, words))).astype(np.float32)
    candidates, competes = rng.random((1000, 3)) < 0.8, rng.random((3, words)) < 0.7
    found = scoring.confidences(scores, np.asfortranarray(others), candidates, competes, np.float32(10))
    monkeypatch.setattr(matching, "compiled", lambda count: False)
    np.testing.assert_allclose(found, matching.confidences(scores, others, candidates, competes, 0.1), rtol=1e-3)
    for w in range(3):
        largest, odds = matching.beside(scores[:, w], others[:, competes[w]], 0.1)
        expected = np.where(candidates[:, w] & (largest <= 0), matching.softmax(odds), 0)
        np.testing.assert_allclose(found[:, w], expected, rtol=1e-3)


def test_only_what_hangs_together_with_a_seed_grows() -> None:
    voxels = np.array([(0, 0, 0), (1, 1, 1), (2, 2, 2), (9, 0, 0), (9, 0, 1)], np.int32)
    seeds = np.array([False, False, True, False, False])
    assert matching.grown(seeds, connected(voxels)).tolist() == [True, True, True, False, False]
    assert not matching.grown(np.zeros(5, bool), connected(voxels)).any()
    assert matching.grown(np.ones(5, bool), connected(voxels)).all()
