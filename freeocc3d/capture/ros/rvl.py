"""Decodes RVL, a lossless compression of depth.

Source: A. D. Wilson, Fast Lossless Depth Image Compression, ISS 2017.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...core.compiling import njit


def decode_rvl(data: bytes, count: int) -> NDArray[np.uint16] | None:
    """(P,) ``count`` pixels of RVL words; None if the bytes are cut off or damaged."""
    words = np.frombuffer(data, "<u4", len(data) // 4).astype(np.uint32)
    found = np.zeros(count, np.uint16)
    return found if _unpack(words, found) else None


@njit(cache=True)
def _take(words, at):  # type: ignore[no-untyped-def]
    """A number of three bits per nibble, lowest first, and the next nibble; -1 at the end."""
    value, shift = 0, 0
    while at < 8 * len(words) and shift < 33:
        nibble = (int(words[at >> 3]) >> (28 - 4 * (at & 7))) & 15
        at += 1
        value |= (nibble & 7) << shift
        shift += 3
        if nibble < 8:
            return value, at
    return -1, at


@njit(cache=True)
def _unpack(words, out):  # type: ignore[no-untyped-def]
    """Fill (P,) uint16 pixels from RVL's runs of zeros and of differences; false if the words end before."""
    at, pixel, previous = 0, 0, 0
    while pixel < len(out):
        zeros, at = _take(words, at)
        count, at = _take(words, at)
        if zeros < 0 or count < 0 or zeros + count == 0 or pixel + zeros + count > len(out):
            return False
        pixel += zeros
        for _ in range(count):
            folded, at = _take(words, at)
            if folded < 0:
                return False
            previous += (folded >> 1) ^ -(folded & 1)
            out[pixel] = previous & 0xFFFF
            pixel += 1
    return True
