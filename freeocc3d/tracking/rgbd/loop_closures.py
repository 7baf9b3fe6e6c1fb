"""Finds loop closures: keyframes that show the same place, found by features and verified by geometry.

One wrong closure can bend a whole map, so a closure must pass four tests. Enough features agree on one pose. Dense
alignment from this pose finds matching surfaces and similar intensities. The aligned pose stays near the pose from the
features. A neighbor of one of the two keyframes, moved by the closure, also aligns with the other keyframe.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray

from ...core.threads import count_threads
from ...core.transforms import invert, measure_pose_difference
from ..pose_graph import Edge
from . import dense_alignment
from .keyframe_registration import KeyframeView, register_by_features
from .orb_features import OrbFeatures, match_binary
from .place_recognition import Vocabulary, compare_histograms

CANDIDATES = 4
"""Number of most similar keyframes to compare each keyframe with."""

_LEAST_SIMILAR = 0.15
"""Smallest cosine between the histograms of visual words of two compared keyframes."""

_BETWEEN = 3  # smallest number of keyframes on the path between two compared ones
_FEATURES = 20
"""Smallest number of features that agree on a pose: nearly twice what a pose needs, because a closure bends the map."""

_SAMPLE = 300  # features of each frame for ranking keyframes: enough for an order
_LEAST_OVERLAP, _LEAST_INLIERS, _LEAST_CORRELATION = 0.35, 0.75, 0.7
"""Smallest values for the dense alignment of a closure: share of the view in common, share of it on the other's
surface, and correlation of the intensities. Stricter than in tracking, where the frame before supports a pose."""

_NEAR_M, _NEAR_DEG = 0.10, 4.0
"""Largest motion by dense alignment of a pose from features, or of a neighbor's pose that the closure predicts."""


def find_closures(
    keyframes: Sequence[KeyframeView], submap: Sequence[int], T_world_keyframe: Sequence[NDArray[np.float64]]
) -> list[Edge]:
    """Verified closures among K keyframes.

    submap: (K,) submap number of each keyframe.  T_world_keyframe: their poses; only poses of the same submap are
    compared.
    """
    with ThreadPoolExecutor(count_threads()) as pool:
        candidates = _candidates(keyframes, submap, pool)
        found = pool.map(lambda pair: verify_closure(keyframes, submap, T_world_keyframe, *pair), candidates)
        return [edge for edge in found if edge is not None]


def _candidates(
    keyframes: Sequence[KeyframeView], submap: Sequence[int], pool: ThreadPoolExecutor
) -> list[tuple[int, int]]:
    """(later, earlier) rows that look alike and are not close on the path."""
    described = [keyframe.features.descriptors for keyframe in keyframes]
    if sum(map(len, described)) < _FEATURES * 2:
        return []
    vocabulary = Vocabulary(described)
    alike = compare_histograms(np.stack(list(pool.map(vocabulary.histogram, described))))
    pairs, rows = set(), np.arange(len(keyframes))
    for n in range(len(keyframes)):
        near = (np.abs(rows - n) <= _BETWEEN) & (np.asarray(submap) == submap[n])
        scores = np.where(near, -1, alike[n])
        best = np.argsort(-scores, kind="stable")[:CANDIDATES]
        pairs |= {(max(n, int(m)), min(n, int(m))) for m in best if scores[m] >= _LEAST_SIMILAR}
    return sorted(pairs)


def count_common_features(a: OrbFeatures, b: OrbFeatures) -> int:
    """Number of sampled features of two frames that are each other's nearest, and near."""
    few = [OrbFeatures(f.pixels[:_SAMPLE], f.descriptors[:_SAMPLE]) for f in (a, b)]
    return len(match_binary(*few))


def verify_closure(
    keyframes: Sequence[KeyframeView],
    submap: Sequence[int],
    T_world_keyframe: Sequence[NDArray[np.float64]],
    source: int,
    target: int,
) -> Edge | None:
    """The loop closure of two keyframes, or None if a test fails."""
    found = register_by_features(keyframes[source], keyframes[target])
    if found is None or found.agreeing < _FEATURES:
        return None
    closed = found.aligned
    if not _falls_into_place(closed) or not _near(found.by_features, closed.T_target_source):
        return None

    def agrees(a: int, b: int) -> bool:
        """Whether keyframes a and b align at the pose that the closure and the path predict."""
        T_source_a = invert(T_world_keyframe[source]) @ T_world_keyframe[a]
        guess = invert(T_world_keyframe[b]) @ T_world_keyframe[target] @ closed.T_target_source @ T_source_a
        aligned = dense_alignment.align_views(keyframes[a].view, keyframes[b].view, guess)
        return _falls_into_place(aligned) and _near(guess, aligned.T_target_source)

    def beside(row: int) -> list[int]:
        """The neighbors of a keyframe on the path."""
        return [n for n in (row - 1, row + 1) if 0 <= n < len(keyframes) and submap[n] == submap[row]]

    pairs = [*((n, target) for n in beside(source)), *((source, n) for n in beside(target))]
    if not any(agrees(a, b) for a, b in pairs if a != b and {a, b} != {source, target}):
        return None
    return Edge(source, target, closed.T_target_source, closed.information, uncertain=True)


def _falls_into_place(aligned: dense_alignment.ViewAlignment) -> bool:
    return (
        aligned.determined
        and aligned.overlap >= _LEAST_OVERLAP
        and aligned.inliers >= _LEAST_INLIERS
        and aligned.correlation >= _LEAST_CORRELATION
    )


def _near(T_a: NDArray[np.float64], T_b: NDArray[np.float64]) -> bool:
    meters, degrees = measure_pose_difference(T_a, T_b)
    return meters <= _NEAR_M and degrees <= _NEAR_DEG
