"""Scores of very many coded features, compiled: each feature is unpacked and compared within the CPU's cache."""

from __future__ import annotations

import math

import numpy as np
from numba import prange
from numpy.typing import NDArray

from ..core.compiling import njit

_TILE = 64


@njit(parallel=True, fastmath=True, cache=True)
def compute_coded_cosines(
    codes: NDArray[np.uint8],
    fours: int,
    twos: int,
    scale: NDArray[np.float32],
    offset: NDArray[np.float32],
    text: NDArray[np.float32],
) -> NDArray[np.float32]:
    """``Codec.cosines`` with (W, R) texts in the codec's coordinates. fours, twos: the number of bytes that contain
    levels of 4 and of 2 bits; they follow the bytes with levels of 8 bits."""
    eights = codes.shape[1] - fours - twos
    out = np.empty((len(text), len(codes)), np.float32)
    for tile in prange((len(codes) + _TILE - 1) // _TILE):
        x = np.empty(len(scale), np.float32)
        for v in range(tile * _TILE, min((tile + 1) * _TILE, len(codes))):
            at = eights
            for i in range(eights):
                x[i] = np.float32(codes[v, i])
            for i in range(fours):
                code = codes[v, eights + i]
                x[at + i], x[at + fours + i] = np.float32(code & 15), np.float32(code >> 4)
            at += 2 * fours
            for i in range(twos):
                code = codes[v, eights + fours + i]
                x[at + i], x[at + twos + i] = np.float32(code & 3), np.float32((code >> 2) & 3)
                x[at + 2 * twos + i], x[at + 3 * twos + i] = np.float32((code >> 4) & 3), np.float32(code >> 6)
            squared = np.float32(0)
            for r in range(len(x)):
                x[r] = x[r] * scale[r] + offset[r]
                squared += x[r] * x[r]
            known = codes[v, 0] > 0 and squared > 0
            inverse = np.float32(1 / math.sqrt(squared)) if known else np.float32(0)
            fours_of_words = len(text) - len(text) % 4
            for w in range(0, fours_of_words, 4):  # x is read once for four words
                a, b, c, d = np.float32(0), np.float32(0), np.float32(0), np.float32(0)
                for r in range(len(x)):
                    a += x[r] * text[w, r]
                    b += x[r] * text[w + 1, r]
                    c += x[r] * text[w + 2, r]
                    d += x[r] * text[w + 3, r]
                out[w, v], out[w + 1, v], out[w + 2, v], out[w + 3, v] = (
                    a * inverse,
                    b * inverse,
                    c * inverse,
                    d * inverse,
                )
            for w in range(fours_of_words, len(text)):
                a = np.float32(0)
                for r in range(len(x)):
                    a += x[r] * text[w, r]
                out[w, v] = a * inverse
    return out.T


@njit(parallel=True, fastmath=True, cache=True)
def compare_coded_competitors(
    scores: NDArray[np.float32], others: NDArray[np.float32], inverse_temperature: np.float32
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """``word_matching.compare_competitors`` with (C, V) others."""
    largest, odds = np.empty(len(scores), np.float32), np.empty(len(scores), np.float32)
    for tile in prange((len(scores) + _TILE - 1) // _TILE):
        start, end = tile * _TILE, min((tile + 1) * _TILE, len(scores))
        for v in range(start, end):
            largest[v], odds[v] = np.float32(-1), np.float32(0)
        for word in range(len(others)):
            for v in range(start, end):
                margin = others[word, v] - scores[v]
                largest[v] = max(largest[v], margin)
                odds[v] += math.exp(margin * inverse_temperature)
    return largest, odds


@njit(parallel=True, fastmath=True, cache=True)
def compute_coded_confidences(
    scores: NDArray[np.float32],
    others: NDArray[np.float32],
    candidates: NDArray[np.bool_],
    competes: NDArray[np.bool_],
    inverse_temperature: np.float32,
) -> NDArray[np.float32]:
    """``word_matching.compute_confidences``. It compares first with the other word that fits a voxel best, because that
    word beats most words."""
    words, rivals = competes.shape
    out = np.zeros((len(scores), words), np.float32)
    for tile in prange((len(scores) + _TILE - 1) // _TILE):
        own = np.empty(rivals, np.float32)
        for v in range(tile * _TILE, min((tile + 1) * _TILE, len(scores))):
            top = 0
            for c in range(rivals):
                own[c] = others[v, c]
                if own[c] > own[top]:
                    top = c
            for w in range(words):
                score = scores[v, w]
                if not candidates[v, w] or (rivals > 0 and competes[w, top] and own[top] > score):
                    continue
                odds, beaten = np.float32(0), False
                for c in range(rivals):
                    if competes[w, c]:
                        beaten |= own[c] > score
                        odds += math.exp((own[c] - score) * inverse_temperature)
                if not beaten:
                    out[v, w] = 1 / (1 + odds)
    return out
