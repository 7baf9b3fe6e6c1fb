"""Disjoint sets: members of one set have one root, its first member."""

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from freeocc3d.core.union_find import find_root, join_sets


def test_sets_are_the_connected_components() -> None:
    pairs = np.random.default_rng(0).integers(0, 60, (40, 2))
    parent = np.arange(60, dtype=np.int32)
    for a, b in pairs.tolist():
        join_sets(parent, a, b)
    graph = coo_array((np.ones(len(pairs)), tuple(pairs.T)), shape=(60, 60))
    component = connected_components(graph, directed=False)[1]
    first = [int(np.flatnonzero(component == component[member])[0]) for member in range(60)]
    assert [find_root(parent, member) for member in range(60)] == first
