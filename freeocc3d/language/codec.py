"""Small features: 8-bit scalar quantisation, a scale and an offset per dimension."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

_LEVELS = 254
"""Codes 1…255 are levels; code 0 in every dimension is the zero feature, of which nothing is known."""
_MARGIN = 0.02
"""By which the range of a dimension is widened on either side: a normalised mean of features can lie outside of it."""
_ROWS = 8192  # worked on at once, so that float32 copies of all rows never exist


@dataclass(frozen=True)
class Codec:
    """(V, D) unit features to (V, D) uint8 and back; a byte a dimension.

    offset, scale: (D,) float32; value = offset + scale * (code - 1), and the row of values is normalised.
    """

    offset: NDArray[np.float32]
    scale: NDArray[np.float32]

    @classmethod
    def fit(cls, features: NDArray[np.floating]) -> Codec:
        """The range of each dimension over (N, D) features, rows of zeros left out, and a margin that does not cross
        zero (what never is negative decodes to exact zeros)."""
        dimension = features.shape[1]
        low, high = np.full(dimension, np.inf, np.float32), np.full(dimension, -np.inf, np.float32)
        for rows in _chunks(features):
            known = rows[rows.any(axis=1)].astype(np.float32)
            low = np.minimum(low, known.min(axis=0, initial=np.inf))
            high = np.maximum(high, known.max(axis=0, initial=-np.inf))
        if not np.isfinite(low).all():
            return cls(np.zeros(dimension, np.float32), np.full(dimension, 1 / _LEVELS, np.float32))
        low = np.where(low >= 0, np.maximum(low - _MARGIN, 0.0), low - _MARGIN).astype(np.float32)
        high = np.where(high <= 0, np.minimum(high + _MARGIN, 0.0), high + _MARGIN).astype(np.float32)
        return cls(low, np.maximum(high - low, np.float32(1e-6)) / np.float32(_LEVELS))

    def encode(self, features: NDArray[np.floating]) -> NDArray[np.uint8]:
        """(V, D) features to codes; values outside the range are clipped to it."""
        codes = np.empty(features.shape, np.uint8)
        for rows, out in zip(_chunks(features), _chunks(codes), strict=True):
            level = np.clip(np.rint((rows.astype(np.float32) - self.offset) / self.scale), 0, _LEVELS)
            out[:] = np.where(rows.any(axis=1, keepdims=True), level + 1, 0)
        return codes

    def decode(self, codes: NDArray[np.uint8]) -> NDArray[np.float16]:
        """(V, D) codes to unit features; the zero feature comes back exactly."""
        features = np.empty(codes.shape, np.float16)
        for rows, out in zip(_chunks(codes), _chunks(features), strict=True):
            values = self.offset + self.scale * (rows.astype(np.float32) - 1)
            values[~rows.any(axis=1)] = 0
            norms = np.linalg.norm(values, axis=1, keepdims=True)
            out[:] = values / np.where(norms > 0, norms, 1)
        return features

    def similarity(self, codes: NDArray[np.uint8], text: NDArray[np.floating]) -> NDArray[np.float32]:
        """(V, W) cosines of coded features with (W, D) unit text features, without decoding them all: with codes c the
        dot product is c (scale * t) + (offset - scale) t, and the squared norm is a quadratic in c. Zero features give
        zero."""
        base = (self.offset - self.scale).astype(np.float32)
        weight = (text * self.scale).astype(np.float32).T
        constant = (text @ base).astype(np.float32)
        scores = np.empty((len(codes), len(text)), np.float32)
        for rows, out in zip(_chunks(codes), _chunks(scores), strict=True):
            c = rows.astype(np.float32)
            squared = (c * c) @ self.scale**2 + c @ (2 * self.scale * base) + base @ base
            known = rows.any(axis=1) & (squared > 0)
            norms = np.sqrt(np.where(known, squared, 1.0))
            out[:] = np.where(known, 1.0, 0.0)[:, None] * (c @ weight + constant) / norms[:, None]
        return scores

    def tables(self) -> dict[str, NDArray[np.float32]]:
        """What ``from_tables`` needs."""
        return {"offset": self.offset, "scale": self.scale}

    @classmethod
    def from_tables(cls, tables: Mapping[str, NDArray[np.float32]]) -> Codec:
        """The codec that a map was saved with."""
        return cls(tables["offset"], tables["scale"])


def _chunks(rows: NDArray[Any]) -> list[NDArray[Any]]:
    """Views of successive rows."""
    return [rows[start : start + _ROWS] for start in range(0, len(rows), _ROWS)]
