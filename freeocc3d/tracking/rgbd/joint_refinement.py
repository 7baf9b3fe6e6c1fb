"""Refines all keyframe poses jointly, by the dense and feature residuals of every overlapping pair.

For a pair (s, t) of keyframes with T_ts = T_t^-1 T_s, both kinds of residuals give normal equations H, g of
T_ts <- exp(xi) T_ts (``dense_residuals``, ``orb_features``). Moving the keyframes by exp(xi_s), exp(xi_t) from the left
moves T_ts by A (xi_s - xi_t), A = Ad(T_t^-1). So the pair adds A^T H A to the blocks (s, s) and (t, t), and its
negative to (s, t). Each Gauss-Newton step solves for all keyframes.

A pair finds new correspondences only after its T_ts has moved by more than ``_MOVED`` since the last time. Until then
H stays and g becomes g + H d, where d is that motion. Most of what a step moves is common to neighboring keyframes, so
after three steps few pairs are linearized: the time is that of the pairs, whose number per keyframe is bounded.

Sources: Q.-Y. Zhou, J. Park, V. Koltun, Fast Global Registration, ECCV 2016, Sec. 3.3 (multi-way), with another
objective for pairs; M. Kaess et al., iSAM2: Incremental Smoothing and Mapping Using the Bayes Tree, IJRR 2012, Sec. 4.2
(fluid relinearization).
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
from .keyframe_registration import FeatureMatches, KeyframeView, match_near

_STRIDE = 2  # step between source pixels: neighboring pixels carry nearly the same information
_LEAST_SHARE, _LEAST_CORRELATION = 0.5, 0.5  # of pixels on the surface, and of intensities; below them a pair disagrees
_MOVED = 1e-4  # radians and meters of a pair after which it is linearized again: less than the error of one alignment
_FAR_M = 0.1  # a motion after which other pairs may overlap, whose depths may differ by a tenth (``overlap``)
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
    """Two overlapping keyframes. H, g: (6, 6), (6,) normal equations where T_target_source was ``linearized_at``; 0 if
    the views disagree there."""

    source: int
    target: int
    matched: FeatureMatches
    weighting: Weighting = field(
        default_factory=lambda: Weighting(np.array(_FIRST_SPREADS), np.array((1.0, 0.0)), dense_alignment.PHOTOMETRIC)
    )
    linearized_at: NDArray[np.float64] = field(default_factory=lambda: np.full((4, 4), np.inf))
    H: NDArray[np.float64] = field(default_factory=lambda: np.zeros((_UNKNOWNS, _UNKNOWNS)))
    g: NDArray[np.float64] = field(default_factory=lambda: np.zeros(_UNKNOWNS))


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
    T = np.array(poses, np.float64)
    if len(T) < 2:
        return list(T)
    made: dict[tuple[int, int], _Pair] = {}
    with ThreadPoolExecutor(count_threads()) as pool:
        for _ in range(rounds):
            before = T.copy()
            chosen = find_overlapping_pairs(keyframes, T, neighbors, least_overlap)
            new = [pair for pair in chosen if pair not in made]
            matches = pool.map(lambda pair: _match(pair, keyframes, T), new)
            made.update({pair: _Pair(*pair, found) for pair, found in zip(new, matches, strict=True)})
            pairs = [made[pair] for pair in chosen]
            for _ in range(iterations):
                if not _step(pairs, keyframes, T, pool):
                    break
            if np.abs(T - before)[:, :3, 3].max() < _FAR_M:
                break
    return [nearest_rigid(pose) for pose in T]


def _match(pair: tuple[int, int], keyframes: Sequence[KeyframeView], T: NDArray[np.float64]) -> FeatureMatches:
    source, target = pair
    return match_near(keyframes[source], keyframes[target], invert(T[target]) @ T[source])


def _step(
    pairs: Sequence[_Pair], keyframes: Sequence[KeyframeView], T: NDArray[np.float64], pool: ThreadPoolExecutor
) -> bool:
    """Move all keyframes, (K, 4, 4) in place, by one step, unless no pair has moved since it was linearized. Returns
    whether it did."""
    source, target = (np.array([getattr(pair, end) for pair in pairs]) for end in ("source", "target"))
    T_target_world = invert(T[target])
    T_ts = T_target_world @ T[source]
    moved = _measure_motion(np.stack([pair.linearized_at for pair in pairs]), T_ts)
    stale = np.flatnonzero(~(np.abs(moved).max(axis=1) <= _MOVED))
    if not len(stale):
        return False
    threads = count_threads()
    work = [stale[thread::threads] for thread in range(threads)]
    for _ in pool.map(lambda rows: _linearize_all([pairs[row] for row in rows], keyframes, T_ts[rows]), work):
        pass
    moved[stale] = 0
    H, g = np.stack([pair.H for pair in pairs]), np.stack([pair.g for pair in pairs])
    g += (H @ moved[..., None])[..., 0]
    A = _adjoint(T_target_world)
    A_T = np.swapaxes(A, 1, 2)
    for pose, xi in zip(T, _solve(source, target, A_T @ H @ A, (A_T @ g[..., None])[..., 0], len(T)), strict=True):
        dense_alignment.apply_twist(pose, xi)
    return True


def _measure_motion(before: NDArray[np.float64], now: NDArray[np.float64]) -> NDArray[np.float64]:
    """(P, 6) xi with exp(xi) before = now for small motions of (P, 4, 4) transforms; not finite where ``before`` is
    not."""
    with np.errstate(invalid="ignore"):
        D = now @ invert(before)
        turned = np.stack((D[:, 2, 1] - D[:, 1, 2], D[:, 0, 2] - D[:, 2, 0], D[:, 1, 0] - D[:, 0, 1]), axis=1) / 2
    return np.concatenate((turned, D[:, :3, 3]), axis=1)


def find_overlapping_pairs(
    keyframes: Sequence[KeyframeView], T: NDArray[np.float64], neighbors: int, least: float
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


def _linearize_all(pairs: Sequence[_Pair], keyframes: Sequence[KeyframeView], T_ts: NDArray[np.float64]) -> None:
    for pair, T in zip(pairs, T_ts, strict=True):
        _linearize(pair, keyframes, T)


def _linearize(pair: _Pair, keyframes: Sequence[KeyframeView], T_ts: NDArray[np.float64]) -> None:
    """Compute the normal equations of a pair at T_target_source."""
    source, target = keyframes[pair.source], keyframes[pair.target]
    a, b = source.view, target.view
    pair.linearized_at = T_ts
    equations = make_equations()
    linearize(a.levels[0], b.levels[0], b.camera, T_ts, _STRIDE, pair.weighting, equations)
    H8, g8, stats = equations
    few = stats[1] * _STRIDE**2 < _LEAST_IN_VIEW * a.points[..., 0].size
    correlation = dense_alignment.compute_correlation(stats)
    if few or dense_alignment.compute_inlier_share(stats) < _LEAST_SHARE or correlation < _LEAST_CORRELATION:
        pair.H, pair.g = np.zeros_like(pair.H), np.zeros_like(pair.g)
        return
    # Intensities that agree less (color shifted against depth, reflections) get less weight.
    if not np.isnan(correlation):  # flat intensities carry no information, at any weight
        agreement = (correlation - _LEAST_CORRELATION) / (1 - _LEAST_CORRELATION)
        pair.weighting = pair.weighting._replace(photometric=dense_alignment.PHOTOMETRIC * agreement**_AGREEMENT_POWER)
    damping = dense_alignment.BRIGHTNESS_DAMPING * np.eye(2)
    pair.weighting.brightness[:] += np.linalg.solve(H8[_UNKNOWNS:, _UNKNOWNS:] + damping, -g8[_UNKNOWNS:])
    pair.H, pair.g, _ = dense_alignment.remove_undetermined(*dense_alignment.eliminate_brightness(H8, g8))
    matched = pair.matched
    orb_features.add_reprojection(matched.points_s, matched.rays_t, T_ts, target.camera.fx, pair.H, pair.g)


def _solve(
    source: NDArray[np.int64],
    target: NDArray[np.int64],
    H: NDArray[np.float64],
    g: NDArray[np.float64],
    count: int,
) -> NDArray[np.float64]:
    """(K, 6) steps of all keyframes from the (P, 6, 6), (P, 6) normal equations of P pairs for the difference of their
    keyframes' motion in the world; the first keyframe stays."""
    row = np.concatenate((source, target, source, target))
    column = np.concatenate((source, target, target, source))
    values = np.concatenate((H, H, -H, -H))
    inside = np.arange(_UNKNOWNS)
    rows = np.broadcast_to(_UNKNOWNS * row[:, None, None] + inside[:, None], values.shape)
    columns = np.broadcast_to(_UNKNOWNS * column[:, None, None] + inside[None, :], values.shape)
    M = csc_matrix((values.ravel(), (rows.ravel(), columns.ravel())), shape=(_UNKNOWNS * count,) * 2)
    right = np.zeros((count, _UNKNOWNS))
    np.add.at(right, source, -g)
    np.add.at(right, target, g)
    hold = _PRIOR + _DAMPING * M.diagonal()
    hold[:_UNKNOWNS] = _FIXED
    return np.asarray(spsolve(M + diags(hold), right.ravel())).reshape(count, _UNKNOWNS)


def _adjoint(T: NDArray[np.float64]) -> NDArray[np.float64]:
    """(P, 6, 6) with T exp(xi) T^-1 = exp(Ad(T) xi) of (P, 4, 4) transforms, rotation before translation."""
    R, t = T[:, :3, :3], T[:, :3, 3]
    A = np.zeros((len(T), _UNKNOWNS, _UNKNOWNS))
    A[:, :3, :3] = A[:, 3:, 3:] = R
    A[:, 3:, :3] = np.cross(t[:, None, :], np.swapaxes(R, 1, 2)).swapaxes(1, 2)  # t x each column
    return A
