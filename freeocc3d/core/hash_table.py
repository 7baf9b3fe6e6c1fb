"""Open-addressing hash tables of 64-bit keys for compiled code. A table is an array of 2^n keys; -1 = empty slot."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from .compiling import njit
from .voxel_keys import KEY_LIMIT, pack_index

packed_key = njit(cache=True, nogil=True)(pack_index)
"""``pack_index`` for compiled code."""


@njit(cache=True, nogil=True)
def cell_index(place: float) -> np.int64:
    """The whole number at or below a place, in cells; the nearest that a key can hold for places farther away."""
    return np.int64(math.floor(min(max(place, np.float64(-KEY_LIMIT)), np.float64(KEY_LIMIT - 1))))


@njit(cache=True, nogil=True)
def find_slot(table: NDArray[np.int64], key: int) -> int:
    """The slot of ``key``, or the empty slot where it belongs."""
    mask = len(table) - 1
    at = (((key * -7046029254386353131) & 0x7FFFFFFFFFFFFFFF) >> 20) & mask  # Fibonacci hashing
    while table[at] != -1 and table[at] != key:
        at = (at + 1) & mask
    return at


@njit(cache=True, nogil=True)
def put_key(table: NDArray[np.int64], count: int, key: int) -> tuple[NDArray[np.int64], int]:
    """Add a key to a set. Returns (table, number of keys); a full table is replaced by a larger one."""
    at = find_slot(table, key)
    if table[at] == key:
        return table, count
    table[at] = key
    if 2 * (count + 1) > len(table):
        grown = np.full(2 * len(table), -1, np.int64)
        for old in table:
            if old != -1:
                grown[find_slot(grown, old)] = old
        table = grown
    return table, count + 1


@njit(cache=True, nogil=True)
def build_table(keys: NDArray[np.int64], room: int) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
    """Map each key to its row: (table of keys, row in each slot), with space for ``room`` keys."""
    size = 1024
    while size < 2 * room + 1:
        size *= 2
    table = np.full(size, -1, np.int64)
    rows = np.full(size, -1, np.int32)
    for row in range(len(keys)):
        at = find_slot(table, keys[row])
        table[at] = keys[row]
        rows[at] = row
    return table, rows


@njit(cache=True, nogil=True)
def find_row(table: NDArray[np.int64], rows: NDArray[np.int32], key: int) -> int:
    """Row of ``key``; -1 if the table does not hold it."""
    at = find_slot(table, key)
    return rows[at] if table[at] == key else -1
