"""Votes of keyframes on pairs of neighbors on the surface."""

import numpy as np

from freeocc3d.query.objects.agglomeration import agglomerate
from freeocc3d.query.objects.mask_votes import weigh_votes


def test_views_that_split_or_join_things_are_outvoted() -> None:
    pairs = np.stack((np.arange(9), np.arange(1, 10)), axis=1)
    rng = np.random.default_rng(0)
    masks = np.repeat([[1, 1, 1, 1, 1, 2, 2, 2, 2, 2]], 12, axis=0)
    masks[0] = 1  # two things as one
    masks[1, 3:5] = 3  # one thing as two
    masks[2] = 0  # no masks
    masks[3:] += rng.integers(0, 9, (9, 1))  # numbers mean nothing from view to view
    a, b = masks[:, pairs[:, 0]], masks[:, pairs[:, 1]]
    known = (a > 0) & (b > 0)
    votes = (known & (a == b)).sum(axis=0), (known & (a != b)).sum(axis=0)
    thing = agglomerate(10, pairs, weigh_votes(*votes, np.ones(9)))
    assert len(set(thing[:5])) == len(set(thing[5:])) == 1
    assert thing[0] != thing[9]


def test_shape_decides_where_no_view_tells() -> None:
    none = np.zeros(2, np.int32)
    assert weigh_votes(none, none, np.array([1.0, -1.0])).tolist() == [1, -1]
    assert weigh_votes(none, none + 1, np.array([1.0, 1.0])).max() < 0
