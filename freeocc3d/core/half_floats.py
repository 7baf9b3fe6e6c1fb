"""Converts half floats to single floats in compiled code. Numba has no half float; NumPy takes four times as long."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .compiling import njit


@njit(cache=True, nogil=True)
def widen_halves(halves: NDArray[np.uint16], bits: NDArray[np.int32], wide: NDArray[np.float32]) -> None:
    """Write (D,) finite float16, given as bits, to ``wide``. ``bits`` is the same memory as ``wide``.

    Exact: the exponents are too small by 112 until the scaling corrects them."""
    for d in range(len(halves)):
        bits[d] = (np.int32(halves[d] & 0x7FFF) << 13) | (np.int32(halves[d] >> 15) << 31)
    for d in range(len(halves)):
        wide[d] *= np.float32(2.0**112)
