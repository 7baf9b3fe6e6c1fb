"""Packs 16-bit depth into bytes: differences of neighbors, which mostly fit one byte.

A pixel is the difference d to the pixel before it, folded to 2 d or -2 d - 1 so that it has no sign: one byte if it is
below 255, else 255 and the two bytes of the pixel itself. This takes a third of the time of PNG, and twice its space.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..core.compiling import njit

MOST_UNITS = 65535
"""Largest integer of a value."""

_ESCAPE = 255
_LONGEST = 3  # bytes of a pixel


def pack_depth(values: NDArray[np.float32], units: float) -> tuple[NDArray[np.uint8], bool]:
    """The (P,) bytes of an array in integer units, at most 65535, and whether they represent it exactly."""
    room = np.empty(_LONGEST * values.size, np.uint8)
    length, exact = _pack(values.reshape(-1), np.float32(units), np.float32(1 / units), room)
    return room[:length], bool(exact)


def unpack_depth(packed: NDArray[np.uint8], shape: tuple[int, int], per_unit: float) -> NDArray[np.float32]:
    """The array of this shape that ``pack_depth`` packed, its integers times ``per_unit``."""
    values = np.empty(shape, np.float32)
    _unpack(packed, np.float32(per_unit), values.reshape(-1))
    return values


def pack_reference(values_m: NDArray[np.float32], units: float) -> tuple[NDArray[np.uint8], bool]:
    """``pack_depth`` in plain NumPy."""
    scaled = values_m.reshape(-1) * np.float32(units) + np.float32(0.5)
    values = np.minimum(scaled, MOST_UNITS).astype(np.int64)
    exact = bool((values.astype(np.float32) * np.float32(1 / units) == values_m.reshape(-1)).all())
    step = np.diff(values, prepend=0)
    folded = np.where(step < 0, -2 * step - 1, 2 * step)
    escaped = folded >= _ESCAPE
    end = np.cumsum(np.where(escaped, _LONGEST, 1))
    packed = np.empty(end[-1] if len(end) else 0, np.uint8)
    packed[end[~escaped] - 1] = folded[~escaped]
    for place, byte in ((3, np.full(len(values), _ESCAPE)), (2, values & 255), (1, values >> 8)):
        packed[end[escaped] - place] = byte[escaped]
    return packed, exact


@njit(cache=True, nogil=True)
def _pack(
    values: NDArray[np.float32], units: np.float32, per_unit: np.float32, packed: NDArray[np.uint8]
) -> tuple[int, bool]:
    """Fills the bytes; returns their number, and whether they represent the values exactly."""
    n, before, exact = 0, 0, True
    for pixel in range(len(values)):
        value = int(min(values[pixel] * units + np.float32(0.5), np.float32(MOST_UNITS)))
        if np.float32(value) * per_unit != values[pixel]:
            exact = False
        step = value - before
        before = value
        folded = -2 * step - 1 if step < 0 else 2 * step
        if folded < _ESCAPE:
            packed[n] = folded
            n += 1
        else:
            packed[n], packed[n + 1], packed[n + 2] = _ESCAPE, value & 255, value >> 8
            n += _LONGEST
    return n, exact


@njit(cache=True, nogil=True)
def _unpack(packed: NDArray[np.uint8], per_unit: np.float32, values: NDArray[np.float32]) -> None:
    n, value = 0, 0
    for pixel in range(len(values)):
        folded = int(packed[n])
        n += 1
        if folded < _ESCAPE:
            value += -((folded + 1) >> 1) if folded & 1 else folded >> 1
        else:
            value = int(packed[n]) | int(packed[n + 1]) << 8
            n += 2
        values[pixel] = np.float32(value) * per_unit
