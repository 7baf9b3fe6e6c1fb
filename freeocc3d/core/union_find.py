"""Disjoint sets in compiled code, as an array of parents. The root of a set is its first member.

Source: R. Tarjan, Efficiency of a Good But Not Linear Set Union Algorithm, J. ACM 22(2), 1975, with path halving.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .compiling import njit


@njit(cache=True)
def find_root(parent: NDArray[np.int32], member: int) -> int:
    """The first member of the set that holds ``member``. Shortens the paths to it."""
    while parent[member] != member:
        parent[member] = parent[parent[member]]
        member = parent[member]
    return member


@njit(cache=True)
def join_sets(parent: NDArray[np.int32], a: int, b: int) -> None:
    """Merge the sets of two members."""
    root_a, root_b = find_root(parent, a), find_root(parent, b)
    parent[max(root_a, root_b)] = min(root_a, root_b)
