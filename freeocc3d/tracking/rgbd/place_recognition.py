"""Place recognition: finds keyframes that show the same place, by features alone.

A vocabulary of visual words is learned from the scan's own descriptors. A keyframe is described by its histogram of
words, in which rare words count more. Similarity is the cosine.

Source: J. Sivic, A. Zisserman, Video Google, ICCV 2003, with k-means on binary descriptors as vectors of ±1: their dot
product corresponds to the Hamming distance.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix

_WORDS, _SAMPLE, _ROUNDS = 512, 20_000, 6
"""Largest number of visual words, number of descriptors to learn them from, and rounds of k-means."""

_TINY = 1e-9  # avoids division by the length of a zero vector


class Vocabulary:
    """Visual words, learned from lists of (N, 32) uint8 descriptors."""

    def __init__(self, descriptors: Sequence[NDArray[np.uint8]]):
        rng = np.random.default_rng(0)
        every = np.concatenate(descriptors)
        sample = _signs(every[rng.permutation(len(every))[:_SAMPLE]])
        words = sample[:_WORDS].copy()
        for _ in range(_ROUNDS):
            nearest = np.argmax(sample @ words.T, axis=1)
            members = csr_matrix(
                (np.ones(len(sample), np.float32), (nearest, np.arange(len(sample)))), (len(words), len(sample))
            )
            sums = members @ sample
            used = members.getnnz(axis=1) > 0
            words[used] = sums[used]
            words /= np.maximum(np.linalg.norm(words, axis=1, keepdims=True), _TINY)
        self._words = words

    def histogram(self, descriptors: NDArray[np.uint8]) -> NDArray[np.float32]:
        """(W,) count of each word."""
        if not len(descriptors):
            return np.zeros(len(self._words), np.float32)
        nearest = np.argmax(_signs(descriptors) @ self._words.T, axis=1)
        return np.bincount(nearest, minlength=len(self._words)).astype(np.float32)


def compare_histograms(histograms: NDArray[np.float32]) -> NDArray[np.float32]:
    """(K, K) cosine of K keyframes' (K, W) histograms, square-rooted and weighted by inverse document frequency."""
    occurs = np.maximum((histograms > 0).sum(axis=0), 1)
    weighted = np.sqrt(histograms) * np.log(1 + len(histograms) / occurs)
    weighted /= np.maximum(np.linalg.norm(weighted, axis=1, keepdims=True), _TINY)
    return np.asarray(weighted @ weighted.T, np.float32)


def _signs(descriptors: NDArray[np.uint8]) -> NDArray[np.float32]:
    """(N, 256) bits as ±1."""
    return np.unpackbits(descriptors, axis=1).astype(np.float32) * 2 - 1
