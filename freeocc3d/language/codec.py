"""Small features: 8-bit scalar quantisation, a scale and an offset per dimension."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

_LEVELS = 254
"""Codes 1…255 are levels; code 0 in every dimension is the zero feature, of which nothing is known."""


@dataclass(frozen=True)
class Codec:
    """(…, D) unit features to (…, D) uint8 and back; a byte a dimension.

    offset, scale: (D,) float32; value = offset + scale * (code - 1).
    """

    offset: NDArray[np.float32]
    scale: NDArray[np.float32]

    @classmethod
    def fit(cls, features: NDArray[np.floating]) -> Codec:
        """The range of each dimension over (N, D) features, rows of zeros left out."""
        known = features[features.any(axis=1)].astype(np.float32)
        if len(known) == 0:
            return cls(np.zeros(features.shape[1], np.float32), np.ones(features.shape[1], np.float32))
        low, high = known.min(axis=0), known.max(axis=0)
        return cls(low, np.maximum(high - low, 1e-6) / np.float32(_LEVELS))

    def encode(self, features: NDArray[np.floating]) -> NDArray[np.uint8]:
        """(N, D) features to codes; values outside the fitted range are clipped to it."""
        level = np.clip(np.rint((features.astype(np.float32) - self.offset) / self.scale), 0, _LEVELS)
        return np.where(features.any(axis=1, keepdims=True), level + 1, 0).astype(np.uint8)

    def decode(self, codes: NDArray[np.uint8]) -> NDArray[np.float16]:
        """(N, D) codes to unit features; the zero feature comes back exactly."""
        values = self.offset + self.scale * (codes.astype(np.float32) - 1)
        values[~codes.any(axis=1)] = 0
        norms = np.linalg.norm(values, axis=1, keepdims=True)
        return (values / np.where(norms > 0, norms, 1)).astype(np.float16)

    def tables(self) -> dict[str, NDArray[np.float32]]:
        """What ``from_tables`` needs."""
        return {"offset": self.offset, "scale": self.scale}

    @classmethod
    def from_tables(cls, tables: dict[str, NDArray[np.float32]]) -> Codec:
        """The codec that a map was saved with."""
        return cls(tables["offset"], tables["scale"])
