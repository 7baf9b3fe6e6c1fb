"""How well a voxel fits a word compared with other words, and which voxels match. Imports little, to start fast.

With the score s of a voxel for the word, scores c_i for other words, and the encoder's temperature T:

    softmax     exp(s / T) / (exp(s / T) + sum_i exp(c_i / T)); the other words are the contrast words
    relevancy   min_i exp(s / T) / (exp(s / T) + exp(c_i / T)); the other words are phrases that fit anything

Source of the relevancy: J. Kerr et al., LERF: Language Embedded Radiance Fields, ICCV 2023.
"""

from __future__ import annotations

import sys

import numpy as np
from numpy.typing import NDArray

CANONICAL = ("object", "things", "stuff", "texture")
"""LERF's phrases that fit anything."""
MANY = 200_000
"""Number of voxels from which numba is used: for fewer, loading numba takes longer than computing without it."""


def is_worth_compiling(count: int) -> bool:
    """Whether ``count`` voxels are enough for compiled code to be faster."""
    return count >= MANY or "numba" in sys.modules


def compare_competitors(
    scores: NDArray[np.float32], others: NDArray[np.float32], temperature: float
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """(V,) largest c_i - s, and (V,) sum of exp((c_i - s) / T), for (V,) scores and (V, C) others. Without others: -1
    and 0."""
    if is_worth_compiling(len(scores)):
        from . import coded_scores

        largest, odds = coded_scores.compare_coded_competitors(
            scores, np.asfortranarray(others).T, np.float32(1 / temperature)
        )
        return np.asarray(largest), np.asarray(odds)
    margin = others - scores[:, None]
    return margin.max(axis=1, initial=-1.0), np.exp(margin / np.float32(temperature)).sum(axis=1)


def compute_confidences(
    scores: NDArray[np.float32],
    others: NDArray[np.float32],
    candidates: NDArray[np.bool_],
    competes: NDArray[np.bool_],
    temperature: float,
) -> NDArray[np.float32]:
    """(V, W) softmax of W words against those of C others that compete with them, (W, C), where a word is a candidate
    and none of these others scores higher; 0 elsewhere.

    scores: (V, W) of the words, others: (V, C) of the others.
    """
    if is_worth_compiling(len(scores)):
        from . import coded_scores

        return np.asarray(
            coded_scores.compute_coded_confidences(scores, others, candidates, competes, np.float32(1 / temperature))
        )
    out = np.zeros(scores.shape, np.float32)
    by_word = np.ascontiguousarray(others.T)  # usually their order in memory
    for w, rivals in enumerate(competes):
        rows = np.flatnonzero(candidates[:, w])
        margin = by_word[np.ix_(rivals, rows)] - scores[rows, w]
        best = margin.max(axis=0, initial=-1.0) <= 0
        out[rows[best], w] = compare_with_all(np.exp(margin[:, best] / np.float32(temperature)).sum(axis=0))
    return out


def compare_with_all(odds: NDArray[np.float32]) -> NDArray[np.float32]:
    """(V,) probability of the word compared with all others together."""
    return np.asarray(1 / (1 + odds), np.float32)


def compare_with_best(largest: NDArray[np.float32], temperature: float) -> NDArray[np.float32]:
    """(V,) probability of the word compared with the best of the others."""
    return np.asarray(1 / (1 + np.exp(np.minimum(largest / np.float32(temperature), 80))), np.float32)


def grow_regions(seeds: NDArray[np.bool_], component: NDArray[np.int32]) -> NDArray[np.bool_]:
    """(V,) which voxels are connected to a seed, given the component of each: regions start where a word fits well, and
    end where it no longer fits (hysteresis; J. Canny, A Computational Approach to Edge Detection, PAMI 1986)."""
    return np.asarray(np.bincount(component, seeds)[component] > 0)
