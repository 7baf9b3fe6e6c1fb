"""Merges parts of a graph with signed weights: average linkage, as long as a mean weight is positive.

Average linkage with signed weights needs no number of parts, and one wrong edge between two large parts does not join
them. Source: A. Bailoni et al., GASP, a generalized framework for agglomerative clustering of signed graphs, CVPR 2022.
Two parts that are each other's best partners can be merged in any order: average linkage is reducible. So all such
pairs are merged together. Source: F. Murtagh, A survey of recent advances in hierarchical clustering algorithms, 1983.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

_TIE = 1e-6
"""Largest random difference between equal weights: among many equals, few would be each other's best."""


def agglomerate(count: int, edges: NDArray[np.int64], weights: NDArray[np.float64]) -> NDArray[np.int64]:
    """Returns the (count,) part of each node, numbered from 0.

    edges: (E, 2) nodes; an edge that occurs several times counts as often.  weights: (E,), positive to join.
    """
    total = weights + np.random.default_rng(0).uniform(0, _TIE, len(weights))
    number = np.ones(len(edges))
    pairs, member = edges.astype(np.int64), np.arange(count)  # member: a node of each part that still has edges
    merges = [np.zeros((0, 2), np.int64)]
    while True:
        kept = pairs[:, 0] != pairs[:, 1]
        active, pairs = np.unique(pairs[kept], return_inverse=True)
        member, pairs = member[active], pairs.reshape(-1, 2)
        keys, which = np.unique(pairs.min(axis=1) * len(active) + pairs.max(axis=1), return_inverse=True)
        total = np.asarray(np.bincount(which, total[kept]), np.float64)
        number = np.asarray(np.bincount(which, number[kept]), np.float64)
        pairs = np.stack((keys // max(len(active), 1), keys % max(len(active), 1)), axis=1)
        mean = total / number
        best = np.zeros(len(active))
        np.maximum.at(best, pairs[:, 0], mean)
        np.maximum.at(best, pairs[:, 1], mean)
        joined = (mean > 0) & (mean[:, None] == best[pairs]).all(axis=1)
        if not joined.any():
            return _connect(count, np.concatenate(merges))[1]
        merges.append(member[pairs[joined]])
        parts, merged = _connect(len(active), pairs[joined])
        pairs, members = merged[pairs], np.empty(parts, np.int64)
        members[merged] = member
        member = members


def _connect(count: int, pairs: NDArray[np.int64]) -> tuple[int, NDArray[np.int64]]:
    """Returns the number of connected components, and the (count,) component of each node."""
    graph = coo_array((np.ones(len(pairs), bool), tuple(pairs.T)), shape=(count, count))
    parts, part = connected_components(graph, directed=False)
    return int(parts), part.astype(np.int64)
