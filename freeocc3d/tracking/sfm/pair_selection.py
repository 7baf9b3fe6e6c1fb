"""Chooses the pairs of images to compare: those that follow each other, and those that look alike.

An image is described by the residuals of its features to words that are learned from the scan. Similarity is the
cosine.

Source: H. Jégou et al., Aggregating Local Descriptors into a Compact Image Representation, CVPR 2010 (VLAD).
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.cluster.vq import kmeans2

OF_IMAGE = 1000
"""Number of features that suffice to describe an image."""

_WORDS, _SAMPLE, _ROUNDS = 64, 20_000, 8
_NEAR = 5  # in a video, the next frame is among this many most similar images


def compare_images(descriptors: Sequence[NDArray[np.float32]]) -> NDArray[np.float32]:
    """(N, N) cosine similarity of N images. descriptors: (F, D) of each image, of unit length."""
    rng = np.random.default_rng(0)
    sampled = [d[rng.permutation(len(d))[: max(_SAMPLE // len(descriptors), 1)]] for d in descriptors]
    words = _words(np.concatenate(sampled), rng)
    vectors = np.stack([_vlad(d, words) for d in descriptors])
    return np.asarray(vectors @ vectors.T, np.float32)


def _words(sample: NDArray[np.float32], rng: np.random.Generator) -> NDArray[np.float32]:
    """(W, D) cluster centers."""
    start = sample[rng.permutation(len(sample))[:_WORDS]]
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "One of the clusters is empty")  # an empty cluster keeps its center
        return np.asarray(kmeans2(sample, start, _ROUNDS, minit="matrix")[0], np.float32)


def _assigned(descriptors: NDArray[np.float32], words: NDArray[np.float32]) -> NDArray[np.int64]:
    return np.asarray(np.argmax(descriptors @ words.T - 0.5 * (words**2).sum(axis=1), axis=1), np.int64)


def _vlad(descriptors: NDArray[np.float32], words: NDArray[np.float32]) -> NDArray[np.float32]:
    """(W·D,) sums of residuals to the words; each sum has unit length, and so has the whole vector."""
    sums = np.zeros_like(words)
    if len(descriptors):
        nearest = _assigned(descriptors, words)
        np.add.at(sums, nearest, descriptors - words[nearest])
    sums /= np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), 1e-9)
    return np.asarray(sums.ravel() / max(float(np.linalg.norm(sums)), 1e-9), np.float32)


def is_sequence(alike: NDArray[np.float32]) -> bool:
    """Whether successive images look alike, as in a video. alike: (N, N) similarities."""
    if len(alike) <= 2 * _NEAR:
        return False
    others = np.where(np.eye(len(alike), dtype=bool), -np.inf, alike)
    successor = np.diagonal(others, 1)
    rank = (others[:-1] > successor[:, None]).sum(axis=1)
    return bool(np.median(rank) < _NEAR)


def choose_pairs(alike: NDArray[np.float32], follow: int, retrieved: int) -> NDArray[np.int64]:
    """(P, 2) pairs (i < j) of N images, the closest in order first: each image with the next ``follow`` images and with
    the ``retrieved`` most similar ones.

    alike: (N, N) similarities. Use ``follow`` 0 for images in no order. ``retrieved`` N - 1 gives all pairs.
    """
    n = len(alike)
    rows = np.arange(n)
    gap = np.abs(rows[:, None] - rows)
    wanted = (gap > 0) & (gap <= follow)
    elsewhere = np.where((gap == 0) | wanted, -np.inf, alike)
    best = np.argsort(-elsewhere, axis=1, kind="stable")[:, : min(retrieved, n - 1)]
    wanted[rows[:, None], best] |= np.isfinite(np.take_along_axis(elsewhere, best, axis=1))
    found = np.argwhere(np.triu(wanted | wanted.T, 1))
    return found[np.argsort(found[:, 1] - found[:, 0], kind="stable")]
