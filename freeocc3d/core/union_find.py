"""Disjoint sets in compiled code: an array of parents, in which a set's first member is its root.

Source: R. Tarjan, Efficiency of a Good But Not Linear Set Union Algorithm, J. ACM 22(2), 1975, with path halving.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray


@njit(cache=True)
def find_root(parent: NDArray[np.int32], member: int) -> int:
    """The first member of a member's set; paths to it get shorter."""
    while parent[member] != member:
        parent[member] = parent[parent[member]]
        member = parent[member]
    return member


@njit(cache=True)
def join_sets(parent: NDArray[np.int32], a: int, b: int) -> None:
    """Make one set of those of two members."""
    root_a, root_b = find_root(parent, a), find_root(parent, b)
    parent[max(root_a, root_b)] = min(root_a, root_b)
