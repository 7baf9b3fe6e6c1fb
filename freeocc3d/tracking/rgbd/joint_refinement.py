"""Refines all keyframe poses jointly, by the dense and feature residuals of every overlapping pair.

For a pair (s, t) of keyframes with T_ts = T_t^-1 T_s, both kinds of residuals give normal equations H, g of
T_ts <- exp(xi) T_ts (``dense_residuals``, ``orb_features``). Moving the keyframes by exp(xi_s), exp(xi_t) from the left
moves T_ts by A (xi_s - xi_t), A = Ad(T_t^-1). So the pair adds A^T H A to the blocks (s, s) and (t, t), and its
negative to (s, t). Each Gauss-Newton step solves for all keyframes, and each step finds new correspondences.

Source: Q.-Y. Zhou, J. Park, V. Koltun, Fast Global Registration, ECCV 2016, Sec. 3.3 (multi-way), with another
objective for pairs.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_matrix, diags
from scipy.sparse.linalg import spsolve

from ...core.threads import count_threads
from ...core.transforms import invert, nearest_rigid
from ..overlap import measure_mutual_overlap
from . import dense_alignment, orb_features
from .dense_residuals import Weighting, linearize, make_equations
from .keyframe_registration import FeatureMatches, KeyframeView, match_keyframes

_STRIDE = 2  # step between source pixels: neighboring pixels carry nearly the same information
_LEAST_SHARE, _LEAST_CORRELATION = 0.5, 0.5  # of pixels on the surface, and of intensities; below them a pair disagrees
_STILL, _FAR_M = 5e-5, 0.02  # a step that ends the iteration; a motion after which other pairs may overlap
_PRIOR = 1.0  # information that holds a keyframe without pairs
_DAMPING = 1e-4  # share of its own information that holds every keyframe, to bound a step
_FIXED = 1e15  # information of the first keyframe, which stays
_FIRST_SPREADS = (3.0, 5.0)  # initial spreads of the residuals, after tracking has aligned the keyframes once
_LEAST_IN_VIEW = 0.05  # share of the source's pixels that must lie in the target's view
_AGREEMENT_POWER = 4  # exponent of the agreement in the weight of the intensities
_CANDIDATES = 4  # number of candidates per chosen neighbor
_UNKNOWNS = 6  # of a pose: rotation, translation


@dataclass
class _Pair:
    source: int
    target: int
    matched: FeatureMatches
    weighting: Weighting = field(
        default_factory=lambda: Weighting(np.array(_FIRST_SPREADS), np.array((1.0, 0.0)), dense_alignment.PHOTOMETRIC)
    )


def refine_poses(
    keyframes: Sequence[KeyframeView],
    poses: Sequence[NDArray[np.float64]],
    neighbors: int = 10,
    least_overlap: float = 0.35,
    rounds: int = 2,
    iterations: int = 5,
) -> list[NDArray[np.float64]]:
    """T_world_keyframe of K keyframes, refined; the first keeps its pose.

    neighbors: number of earlier keyframes to pair each keyframe with, those that share most of its view.  rounds: how
    often pairs are chosen at most; a new round starts only if keyframes moved far.
    """
    T = [np.array(pose, np.float64, order="C") for pose in poses]
    if len(T) < 2:
        return T
    made: dict[tuple[int, int], _Pair] = {}
    with ThreadPoolExecutor(count_threads()) as pool:
        for _ in range(rounds):
            before = np.stack(T)
            chosen = find_overlapping_pairs(keyframes, T, neighbors, least_overlap)
            new = [pair for pair in chosen if pair not in made]
            matches = pool.map(lambda pair: match_keyframes(keyframes[pair[0]], keyframes[pair[1]]), new)
            made.update({pair: _Pair(*pair, found) for pair, found in zip(new, matches, strict=True)})
            pairs = [made[pair] for pair in chosen]
            for _ in range(iterations):
                terms = list(pool.map(lambda pair: _terms(pair, keyframes, T), pairs))
                step = _solve([pair for pair, term in zip(pairs, terms, strict=True) if term is not None],
                              [term for term in terms if term is not None], len(T))  # fmt: skip
                for k, xi in enumerate(step):
                    dense_alignment.apply_twist(T[k], xi)
                if np.abs(step).max() < _STILL:
                    break
            if np.abs(np.stack(T) - before)[:, :3, 3].max() < _FAR_M:
                break
    return [nearest_rigid(pose) for pose in T]


def find_overlapping_pairs(
    keyframes: Sequence[KeyframeView], T: Sequence[NDArray[np.float64]], neighbors: int, least: float
) -> list[tuple[int, int]]:
    """(source, target) of the keyframes that share most of their views, and of each keyframe and the one before it."""
    pairs = set()
    centers = np.stack([_seen(keyframe, pose) for keyframe, pose in zip(keyframes, T, strict=True)])
    for n in range(1, len(T)):
        # If views overlap, the middles of their scenes are near each other: measure only these pairs.
        near = np.argsort(np.linalg.norm(centers[:n] - centers[n], axis=1), kind="stable")[: _CANDIDATES * neighbors]
        T_n_world = invert(T[n])
        shared = [
            (measure_mutual_overlap(keyframes[m].overlap, keyframes[n].overlap, T_n_world @ T[m]), int(m)) for m in near
        ]
        pairs |= {(n, m) for share, m in sorted(shared, reverse=True)[:neighbors] if share >= least}
        pairs.add((n, n - 1))
    return sorted(pairs)


def _seen(keyframe: KeyframeView, T: NDArray[np.float64]) -> NDArray[np.float64]:
    """(3,) world position of the middle of the points that a keyframe sees."""
    points = keyframe.overlap.points
    middle = np.median(points, axis=0) if len(points) else np.zeros(3)
    return np.asarray(T[:3, :3] @ middle + T[:3, 3])


def _terms(
    pair: _Pair, keyframes: Sequence[KeyframeView], T: Sequence[NDArray[np.float64]]
) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """(6, 6), (6,) normal equations of a pair, for the difference of its keyframes' motion in the world; None if the
    views disagree."""
    source, target = keyframes[pair.source], keyframes[pair.target]
    a, b = source.view, target.view
    T_target_world = invert(T[pair.target])
    T_ts = T_target_world @ T[pair.source]
    equations = make_equations()
    linearize(a.levels[0], b.levels[0], b.camera, T_ts, _STRIDE, pair.weighting, equations)
    H8, g8, stats = equations
    few = stats[1] * _STRIDE**2 < _LEAST_IN_VIEW * a.points[..., 0].size
    correlation = dense_alignment.compute_correlation(stats)
    if few or dense_alignment.compute_inlier_share(stats) < _LEAST_SHARE or correlation < _LEAST_CORRELATION:
        return None
    # Intensities that agree less (color shifted against depth, reflections) get less weight.
    if not np.isnan(correlation):  # flat intensities carry no information, at any weight
        agreement = (correlation - _LEAST_CORRELATION) / (1 - _LEAST_CORRELATION)
        pair.weighting = pair.weighting._replace(photometric=dense_alignment.PHOTOMETRIC * agreement**_AGREEMENT_POWER)
    damping = dense_alignment.BRIGHTNESS_DAMPING * np.eye(2)
    pair.weighting.brightness[:] += np.linalg.solve(H8[_UNKNOWNS:, _UNKNOWNS:] + damping, -g8[_UNKNOWNS:])
    H, g, _ = dense_alignment.remove_undetermined(*dense_alignment.eliminate_brightness(H8, g8))
    orb_features.add_reprojection(pair.matched.points_s, pair.matched.rays_t, T_ts, target.camera.fx, H, g)
    A = _adjoint(T_target_world)
    return A.T @ H @ A, A.T @ g


def _solve(
    pairs: Sequence[_Pair], terms: Sequence[tuple[NDArray[np.float64], NDArray[np.float64]]], count: int
) -> NDArray[np.float64]:
    """(K, 6) steps of all keyframes; the first keyframe stays."""
    if not pairs:
        return np.zeros((count, _UNKNOWNS))
    blocks = np.stack([H for H, _ in terms])
    source, target = (np.array([getattr(pair, end) for pair in pairs]) for end in ("source", "target"))
    row = np.concatenate((source, target, source, target))
    column = np.concatenate((source, target, target, source))
    values = np.concatenate((blocks, blocks, -blocks, -blocks))
    inside = np.arange(_UNKNOWNS)
    rows = np.broadcast_to(_UNKNOWNS * row[:, None, None] + inside[:, None], values.shape)
    columns = np.broadcast_to(_UNKNOWNS * column[:, None, None] + inside[None, :], values.shape)
    M = csc_matrix((values.ravel(), (rows.ravel(), columns.ravel())), shape=(_UNKNOWNS * count,) * 2)
    g = np.zeros((count, _UNKNOWNS))
    np.add.at(g, source, np.stack([term for _, term in terms]))
    np.add.at(g, target, -np.stack([term for _, term in terms]))
    hold = _PRIOR + _DAMPING * M.diagonal()
    hold[:_UNKNOWNS] = _FIXED
    return np.asarray(spsolve(M + diags(hold), -g.ravel())).reshape(count, _UNKNOWNS)


def _adjoint(T: NDArray[np.float64]) -> NDArray[np.float64]:
    """(6, 6) with T exp(xi) T^-1 = exp(Ad(T) xi), rotation before translation."""
    R, t = T[:3, :3], T[:3, 3]
    A = np.zeros((_UNKNOWNS, _UNKNOWNS))
    A[:3, :3] = A[3:, 3:] = R
    A[3:, :3] = np.cross(t, R, axisb=0, axisc=0)
    return A
