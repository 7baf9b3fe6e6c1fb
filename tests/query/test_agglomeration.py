"""Average linkage by pairs that are each other's best, against merging the best pair at a time."""

import numpy as np
import pytest

from freeocc3d.query.objects.agglomeration import agglomerate


def merge_best_first(count: int, edges: np.ndarray, weights: np.ndarray) -> list[set[int]]:
    parts = [{node} for node in range(count)]
    while True:
        best, pair = 0.0, None
        for a, first in enumerate(parts):
            for b, second in enumerate(parts[:a]):
                between = [w for (i, j), w in zip(edges.tolist(), weights, strict=True)
                           if (i in first and j in second) or (j in first and i in second)]  # fmt: skip
                if between and np.mean(between) > best:
                    best, pair = float(np.mean(between)), (a, b)
        if pair is None:
            return parts
        parts[pair[1]] |= parts.pop(pair[0])


@pytest.mark.parametrize("seed", range(5))
def test_pairs_that_merge_together_give_the_parts_of_one_merge_after_the_other(seed) -> None:
    random = np.random.default_rng(seed)
    edges = random.integers(0, 16, (40, 2))
    edges = edges[edges[:, 0] != edges[:, 1]]
    weights = random.normal(0, 1, len(edges))
    part = agglomerate(16, edges, weights)
    assert {frozenset(np.flatnonzero(part == k).tolist()) for k in np.unique(part)} == {
        frozenset(nodes) for nodes in merge_best_first(16, edges, weights)
    }


def test_one_wrong_edge_does_not_join_large_parts() -> None:
    """Two squares of nodes that nine edges keep apart and one edge would join."""
    inside = [(i, j) for block in (range(10), range(10, 20)) for i in block for j in block if i < j]
    between = [(i, i + 10) for i in range(10)]
    weights = np.concatenate((np.ones(len(inside)), [0.9], np.full(9, -1.0)))
    part = agglomerate(20, np.array([*inside, *between]), weights)
    assert len(np.unique(part)) == 2
    assert len(agglomerate(3, np.zeros((0, 2), np.int64), np.zeros(0))) == 3
