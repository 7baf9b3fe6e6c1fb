"""Cosines of coded features, compiled, against plain NumPy."""

from __future__ import annotations

import numpy as np
import pytest

from freeocc3d.language.coded_scores import compute_coded_cosines


def unpacked(codes: np.ndarray, fours: int, twos: int) -> np.ndarray:
    """(N, R) levels: bytes of 8 bits, then of 4 and of 2; the low bits of all bytes of a kind come first."""
    eights = codes.shape[1] - fours - twos
    high, low = codes[:, eights : eights + fours], codes[:, eights + fours :]
    parts = [codes[:, :eights], high & 15, high >> 4, *((low >> shift) & 3 for shift in (0, 2, 4, 6))]
    return np.concatenate(parts, axis=1).astype(float)


@pytest.mark.parametrize("words", [1, 4, 7])
@pytest.mark.parametrize(("eights", "fours", "twos"), [(3, 2, 2), (2, 0, 3), (1, 4, 0), (5, 0, 0)])
def test_cosines_are_those_of_the_unpacked_levels(words: int, eights: int, fours: int, twos: int) -> None:
    rng = np.random.default_rng(0)
    codes = rng.integers(0, 256, (150, eights + fours + twos), dtype=np.uint8)
    codes[:, 0] = np.maximum(codes[:, 0], 1)
    codes[[3, 70]] = 0  # nothing is known of these
    levels = unpacked(codes, fours, twos)
    scale, offset = rng.uniform(0.5, 2, levels.shape[1]), rng.normal(size=levels.shape[1]) * 20
    text = rng.normal(size=(words, levels.shape[1]))
    values = levels * scale + offset
    wanted = values @ text.T / np.linalg.norm(values, axis=1, keepdims=True)
    wanted[[3, 70]] = 0
    given = (np.float32(array) for array in (scale, offset, text))
    found = compute_coded_cosines(codes, fours, twos, *given)
    np.testing.assert_allclose(found, wanted, atol=2e-5)
