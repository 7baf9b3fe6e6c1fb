"""Sums of products, compiled, in one order on every machine.

Kernels of this package have no ``fastmath``: it lets the compiler sum in any order. A function would then give one
result where it is compiled, and another one where it comes from the cache within a function that calls it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .compiling import njit


@njit(cache=True, nogil=True)
def sum_products(a: NDArray[np.float32], b: NDArray[np.float32]) -> np.float32:
    """Scalar product of two (D,) vectors. Its eight sums fill a register, so that it takes about as long as a product
    whose order is free."""
    end = len(a) - len(a) % 8
    s0 = s1 = s2 = s3 = s4 = s5 = s6 = s7 = np.float32(0)
    for i in range(0, end, 8):
        s0 += a[i] * b[i]
        s1 += a[i + 1] * b[i + 1]
        s2 += a[i + 2] * b[i + 2]
        s3 += a[i + 3] * b[i + 3]
        s4 += a[i + 4] * b[i + 4]
        s5 += a[i + 5] * b[i + 5]
        s6 += a[i + 6] * b[i + 6]
        s7 += a[i + 7] * b[i + 7]
    for i in range(end, len(a)):
        s0 += a[i] * b[i]
    return ((s0 + s1) + (s2 + s3)) + ((s4 + s5) + (s6 + s7))
