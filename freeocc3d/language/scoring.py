"""Scores of very many coded features, compiled: each is unpacked and compared within the processor's cache."""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

_TILE = 64


@njit(parallel=True, fastmath=True, cache=True)
def cosines(
    codes: NDArray[np.uint8],
    fours: int,
    twos: int,
    scale: NDArray[np.float32],
    offset: NDArray[np.float32],
    text: NDArray[np.float32],
) -> NDArray[np.float32]:
    """``Codec.cosines`` with (W, R) texts in the codec's coordinates. fours, twos: bytes that hold levels of 4 and of 2
    bits, behind those of 8."""
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
            for w in range(len(text)):
                dot = np.float32(0)
                for r in range(len(x)):
                    dot += x[r] * text[w, r]
                out[w, v] = dot * inverse
    return out.T


@njit(parallel=True, fastmath=True, cache=True)
def beside(
    scores: NDArray[np.float32], others: NDArray[np.float32], inverse_temperature: np.float32
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """``matching.beside`` with (C, V) others."""
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
