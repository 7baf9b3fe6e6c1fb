"""Gaussian-to-occupancy projection (paper, Sec. "Gaussian-to-Occupancy Projection") over sparse voxel blocks.

At a voxel's centre x, over the neighbouring Gaussians H(x) = {k : Mahalanobis distance of x to G_k <= cutoff}:

    alpha_k(x) = exp(-1/2 (x - mu_k)^T Sigma_k^-1 (x - mu_k)),   Sigma_k = R(r_k) diag(s_k^2) R(r_k)^T        (A)
    alpha(x)   = 1 - prod_k (1 - alpha_k(x))                      opacity is not part of it                    (B)
    p(G_k | x) = N(x; mu_k, Sigma_k) o_k / sum_j N(x; mu_j, Sigma_j) o_j                                       (C)
    f(x)       = sum_k p(G_k | x) f_k                                                                          (D)

A Gaussian that the cutoff leaves out would have contributed less than exp(-cutoff^2 / 2): 0.011 at the default of 3.
"""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numba import get_num_threads, njit, prange
from numpy.typing import NDArray

from ..errors import ConfigError
from ..geometry import quats_to_rotations
from ..hashing import build_table, find
from ..registry import require_positive
from ..types import BLOCK, Gaussians
from .grid import packed_key, touched_blocks, union

_SMALLEST_SCALE = 1e-5


@dataclass(frozen=True)
class Options:
    """Layer 4: how Gaussians become voxels."""

    voxel_size: float = 0.08
    """Edge of a voxel, metres."""
    cutoff: float = 3.0
    """Neighbourhood of a Gaussian in standard deviations."""
    threshold: float = 0.5
    """Occupied from this alpha on."""
    seen_through: float = 3.0
    """A voxel above the threshold is free all the same when this many times more depth images saw through it than ended
    in it."""

    def __post_init__(self) -> None:
        require_positive(self, "voxel_size", "cutoff", "threshold", "seen_through")
        if self.threshold >= 1:
            raise ConfigError(f"'threshold' must be less than 1, got {self.threshold}.")


@dataclass(frozen=True)
class Bins:
    """Gaussians sorted into the voxel blocks that their neighbourhoods touch.

    packed: (B,) ascending packed block keys.  start: (B + 1,) and gaussian: (P,) list block b's Gaussians as
    ``gaussian[start[b]:start[b + 1]]``.  precision: (N, 6) float32 upper triangle of Sigma^-1 in units of voxels^-2.
    lo, hi: (N, 3) int32 first and last voxel of the neighbourhood's box.  means: (N, 3) float32 in voxels, relative to
    the lattice's origin.  log_weight: (N,) float32 log of o_k |Sigma_k|^-1/2 up to a common constant.
    """

    packed: NDArray[np.int64]
    start: NDArray[np.int64]
    gaussian: NDArray[np.int32]
    means: NDArray[np.float32]
    precision: NDArray[np.float32]
    log_weight: NDArray[np.float32]
    lo: NDArray[np.int32]
    hi: NDArray[np.int32]
    cutoff: float


def bin_gaussians(
    gaussians: Gaussians,
    origin: NDArray[np.float64],
    voxel_size: float,
    cutoff: float,
    shape: tuple[int, int, int] | None = None,
) -> Bins:
    """Sort Gaussians into blocks of the lattice whose voxel (0, 0, 0) has its lower corner at ``origin``.

    shape: only the voxels (0, 0, 0) … shape - 1 are evaluated, however far a Gaussian reaches; all by default.
    """
    means = ((gaussians.means.astype(np.float64) - origin) / voxel_size).astype(np.float32)
    scales = np.maximum(gaussians.scales, _SMALLEST_SCALE).astype(np.float32) / np.float32(voxel_size)
    precision, extent = _precisions(gaussians.quats_wxyz.astype(np.float32), scales)
    log_weight = np.log(np.maximum(gaussians.opacities, 1e-6)) - np.log(scales).sum(axis=1)
    lo, hi = _boxes(means, extent, np.float32(cutoff))
    if shape is not None:
        lo, hi = np.maximum(lo, np.int32(0)), np.minimum(hi, np.array(shape, np.int32) - 1)
    packed, start, gaussian = _sort_by_block(lo, hi)
    return Bins(packed, start, gaussian, means, precision, log_weight.astype(np.float32), lo, hi, cutoff)


def probability(bins: Bins, keys: NDArray[np.int32]) -> NDArray[np.float32]:
    """(B, 512) alpha at every voxel of the bins' blocks, whose (B, 3) keys are given: equations (A) and (B)."""
    return _probability(
        keys, bins.start, bins.gaussian, bins.means, bins.precision, bins.lo, bins.hi, np.float32(bins.cutoff**2)
    )


def posterior_mean(
    bins: Bins, keys: NDArray[np.int32], slots: NDArray[np.int32], values: NDArray[np.floating]
) -> NDArray[np.float32]:
    """(V, D) posterior expectation of per-Gaussian values (N, D) at some voxels: equations (C) and (D).

    slots: (B, 512) row of the output for each voxel of the bins' blocks, -1 for voxels that are not asked for. A voxel
    without a neighbouring Gaussian gets zeros.
    """
    rows = int(slots.max(initial=-1)) + 1
    return _posterior_mean(
        keys, bins.start, bins.gaussian, bins.means, bins.precision, bins.log_weight, bins.lo, bins.hi,
        np.float32(bins.cutoff**2), slots, values, rows,
    )  # fmt: skip


def probability_reference(
    gaussians: Gaussians, points: NDArray[np.float64], cutoff: float = np.inf
) -> NDArray[np.float64]:
    """(P,) alpha at (P, 3) world points: equations (A) and (B) written out, every pair evaluated."""
    squared = _squared_distances(gaussians, points)
    alpha_k = np.where(squared <= cutoff**2, np.exp(-0.5 * squared), 0.0)
    return 1.0 - np.prod(1.0 - alpha_k, axis=1)


def posterior_mean_reference(
    gaussians: Gaussians, points: NDArray[np.float64], values: NDArray[np.floating], cutoff: float = np.inf
) -> NDArray[np.float64]:
    """(P, D) posterior expectation at (P, 3) world points: equations (C) and (D) written out."""
    squared = _squared_distances(gaussians, points)
    density = np.exp(-0.5 * squared) / gaussians.scales.astype(np.float64).prod(axis=1)
    weight = np.where(squared <= cutoff**2, density, 0.0) * gaussians.opacities
    total = weight.sum(axis=1, keepdims=True)
    return (weight / np.where(total > 0, total, 1.0)) @ values


def _squared_distances(gaussians: Gaussians, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """(P, N) squared Mahalanobis distances."""
    R = quats_to_rotations(gaussians.quats_wxyz.astype(np.float64))
    offset = points[:, None] - gaussians.means.astype(np.float64)[None]
    along_axes = np.einsum("pni,nij->pnj", offset, R) / gaussians.scales.astype(np.float64)
    return (along_axes**2).sum(axis=2)


@njit(parallel=True, cache=True)
def _precisions(
    quats: NDArray[np.float32], scales: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Sigma^-1 (N, 6) as xx, xy, xz, yy, yz, zz and the standard deviations along the lattice's axes (N, 3)."""
    n = len(quats)
    precision = np.empty((n, 6), np.float32)
    extent = np.empty((n, 3), np.float32)
    for g in prange(n):
        w, x, y, z = quats[g, 0], quats[g, 1], quats[g, 2], quats[g, 3]
        norm = math.sqrt(w * w + x * x + y * y + z * z)
        w, x, y, z = w / norm, x / norm, y / norm, z / norm
        R = (
            (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
            (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
            (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
        )
        s0, s1, s2 = scales[g, 0] ** 2, scales[g, 1] ** 2, scales[g, 2] ** 2
        p0, p1, p2 = 1 / s0, 1 / s1, 1 / s2
        entry = 0
        for i in range(3):
            a = R[i]
            extent[g, i] = math.sqrt(a[0] * a[0] * s0 + a[1] * a[1] * s1 + a[2] * a[2] * s2)
            for j in range(i, 3):
                b = R[j]
                precision[g, entry] = a[0] * b[0] * p0 + a[1] * b[1] * p1 + a[2] * b[2] * p2
                entry += 1
    return precision, extent


@njit(parallel=True, cache=True)
def _boxes(
    means: NDArray[np.float32], extent: NDArray[np.float32], cutoff: np.float32
) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """First and last voxel whose centre lies in the bounding box of each neighbourhood; lo > hi if none does."""
    n = len(means)
    lo = np.empty((n, 3), np.int32)
    hi = np.empty((n, 3), np.int32)
    for g in prange(n):
        for i in range(3):
            reach = cutoff * extent[g, i]
            lo[g, i] = math.ceil(means[g, i] - reach - 0.5)
            hi[g, i] = math.floor(means[g, i] + reach - 0.5)
    return lo, hi


def _sort_by_block(
    lo: NDArray[np.int32], hi: NDArray[np.int32]
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int32]]:
    """Counting sort of the (Gaussian, block) pairs: the blocks' packed keys, where each block's Gaussians start, and
    the Gaussians. Each thread sorts a part of the Gaussians; the parts keep their order, so that the result is the
    same with any number of threads."""
    bounds = np.linspace(0, len(lo), get_num_threads() + 1).astype(int)
    parts = [slice(first, end) for first, end in pairwise(bounds)]
    with ThreadPoolExecutor(len(parts)) as threads:
        packed = union(*threads.map(lambda part: touched_blocks(lo[part], hi[part]), parts))
        table, rows = build_table(packed, len(packed))
        count = np.stack(list(threads.map(lambda part: _count(table, rows, lo[part], hi[part], len(packed)), parts)))
        start = np.concatenate(([0], np.cumsum(count.sum(axis=0))))
        place = start[:-1] + np.cumsum(count, axis=0) - count  # where each part's share of each block begins
        gaussian = np.empty(start[-1], np.int32)
        list(
            threads.map(
                lambda part, at: _place(table, rows, lo[part], hi[part], part.start, at, gaussian), parts, place
            )
        )
    return packed, start, gaussian


@njit(cache=True, nogil=True)
def _count(
    table: NDArray[np.int64], rows: NDArray[np.int32], lo: NDArray[np.int32], hi: NDArray[np.int32], blocks: int
) -> NDArray[np.int64]:
    """(B,) Gaussians of this part in each block."""
    count = np.zeros(blocks, np.int64)
    for g in range(len(lo)):
        if lo[g, 0] > hi[g, 0] or lo[g, 1] > hi[g, 1] or lo[g, 2] > hi[g, 2]:
            continue
        for i in range(lo[g, 0] >> 3, (hi[g, 0] >> 3) + 1):
            for j in range(lo[g, 1] >> 3, (hi[g, 1] >> 3) + 1):
                for k in range(lo[g, 2] >> 3, (hi[g, 2] >> 3) + 1):
                    count[find(table, rows, packed_key(i, j, k))] += 1
    return count


@njit(cache=True, nogil=True)
def _place(
    table: NDArray[np.int64],
    rows: NDArray[np.int32],
    lo: NDArray[np.int32],
    hi: NDArray[np.int32],
    first: int,
    place: NDArray[np.int64],
    gaussian: NDArray[np.int32],
) -> None:
    """Write this part's Gaussians, numbered from ``first``, at ``place`` (B,), which is used up."""
    for g in range(len(lo)):
        if lo[g, 0] > hi[g, 0] or lo[g, 1] > hi[g, 1] or lo[g, 2] > hi[g, 2]:
            continue
        for i in range(lo[g, 0] >> 3, (hi[g, 0] >> 3) + 1):
            for j in range(lo[g, 1] >> 3, (hi[g, 1] >> 3) + 1):
                for k in range(lo[g, 2] >> 3, (hi[g, 2] >> 3) + 1):
                    b = find(table, rows, packed_key(i, j, k))
                    gaussian[place[b]] = first + g
                    place[b] += 1


@njit(parallel=True, cache=True)
def _probability(
    keys: NDArray[np.int32],
    start: NDArray[np.int64],
    gaussian: NDArray[np.int32],
    means: NDArray[np.float32],
    precision: NDArray[np.float32],
    lo: NDArray[np.int32],
    hi: NDArray[np.int32],
    squared_cutoff: np.float32,
) -> NDArray[np.float32]:
    alpha = np.empty((len(keys), BLOCK**3), np.float32)
    for b in prange(len(keys)):
        x0, y0, z0 = keys[b, 0] * BLOCK, keys[b, 1] * BLOCK, keys[b, 2] * BLOCK
        survival = np.ones(BLOCK**3, np.float32)
        for pair in range(start[b], start[b + 1]):
            g = gaussian[pair]
            pxx, pxy, pxz = precision[g, 0], precision[g, 1], precision[g, 2]
            pyy, pyz, pzz = precision[g, 3], precision[g, 4], precision[g, 5]
            for i in range(max(lo[g, 0] - x0, 0), min(hi[g, 0] - x0, BLOCK - 1) + 1):
                dx = np.float32(x0 + i) + np.float32(0.5) - means[g, 0]
                for j in range(max(lo[g, 1] - y0, 0), min(hi[g, 1] - y0, BLOCK - 1) + 1):
                    dy = np.float32(y0 + j) + np.float32(0.5) - means[g, 1]
                    constant = dx * (pxx * dx + np.float32(2) * pxy * dy) + pyy * dy * dy
                    linear = np.float32(2) * (pxz * dx + pyz * dy)
                    for k in range(max(lo[g, 2] - z0, 0), min(hi[g, 2] - z0, BLOCK - 1) + 1):
                        dz = np.float32(z0 + k) + np.float32(0.5) - means[g, 2]
                        squared = constant + dz * (linear + pzz * dz)
                        if squared <= squared_cutoff:
                            alpha_k = math.exp(np.float32(-0.5) * squared)  # (A)
                            survival[(i * BLOCK + j) * BLOCK + k] *= np.float32(1) - alpha_k
        for voxel in range(BLOCK**3):
            alpha[b, voxel] = np.float32(1) - survival[voxel]  # (B)
    return alpha


@njit(parallel=True, cache=True)
def _posterior_mean(
    keys: NDArray[np.int32],
    start: NDArray[np.int64],
    gaussian: NDArray[np.int32],
    means: NDArray[np.float32],
    precision: NDArray[np.float32],
    log_weight: NDArray[np.float32],
    lo: NDArray[np.int32],
    hi: NDArray[np.int32],
    squared_cutoff: np.float32,
    slots: NDArray[np.int32],
    values: NDArray[np.floating],
    rows: int,
) -> NDArray[np.float32]:
    dimension = values.shape[1]
    mean = np.zeros((rows, dimension), np.float32)
    for b in prange(len(keys)):
        x0, y0, z0 = keys[b, 0] * BLOCK, keys[b, 1] * BLOCK, keys[b, 2] * BLOCK
        total = np.zeros(BLOCK**3, np.float32)
        # Densities of thin and of wide Gaussians differ by orders of magnitude: the block's largest is the unit.
        unit = np.float32(-np.inf)
        for pair in range(start[b], start[b + 1]):
            unit = max(unit, log_weight[gaussian[pair]])
        for pair in range(start[b], start[b + 1]):
            g = gaussian[pair]
            pxx, pxy, pxz = precision[g, 0], precision[g, 1], precision[g, 2]
            pyy, pyz, pzz = precision[g, 3], precision[g, 4], precision[g, 5]
            for i in range(max(lo[g, 0] - x0, 0), min(hi[g, 0] - x0, BLOCK - 1) + 1):
                dx = np.float32(x0 + i) + np.float32(0.5) - means[g, 0]
                for j in range(max(lo[g, 1] - y0, 0), min(hi[g, 1] - y0, BLOCK - 1) + 1):
                    dy = np.float32(y0 + j) + np.float32(0.5) - means[g, 1]
                    constant = dx * (pxx * dx + np.float32(2) * pxy * dy) + pyy * dy * dy
                    linear = np.float32(2) * (pxz * dx + pyz * dy)
                    for k in range(max(lo[g, 2] - z0, 0), min(hi[g, 2] - z0, BLOCK - 1) + 1):
                        voxel = (i * BLOCK + j) * BLOCK + k
                        row = slots[b, voxel]
                        if row < 0:
                            continue
                        dz = np.float32(z0 + k) + np.float32(0.5) - means[g, 2]
                        squared = constant + dz * (linear + pzz * dz)
                        if squared <= squared_cutoff:
                            weight = math.exp(np.float32(-0.5) * squared + log_weight[g] - unit)  # (C), numerator
                            total[voxel] += weight
                            for d in range(dimension):
                                mean[row, d] += weight * values[g, d]  # (D)
        for voxel in range(BLOCK**3):
            row = slots[b, voxel]
            if row >= 0 and total[voxel] > 0:
                for d in range(dimension):
                    mean[row, d] /= total[voxel]  # (C), denominator
    return mean
