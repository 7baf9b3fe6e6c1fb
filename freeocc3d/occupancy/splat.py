"""Gaussian-to-occupancy projection (paper, Sec. "Gaussian-to-Occupancy Projection") over sparse voxel blocks.

Every mode is a product over the neighbouring Gaussians H(x) of a voxel with centre x and box V(x),

    alpha(x) = 1 - prod_{k in H(x)} (1 - c_k(x)),                                                             (B)

with phi_k(x) = exp(-1/2 (x - mu_k)^T Sigma_k^-1 (x - mu_k)), Sigma_k = R(r_k) diag(s_k^2) R(r_k)^T, and

    probabilistic   c_k = phi_k(x): the paper's, opacity is not part of it                                     (A)
    poisson         c_k = 1 - exp(-o_k phi_k(x)), so that alpha = 1 - exp(-sum_k o_k phi_k(x))
    integrated      c_k = the mass of N(mu_k, Sigma_k) within V(x)
    released        as poisson, with Sigma_k (m^2) where Sigma_k^-1 belongs: the paper's code as it seems to run. phi is
                    1 in all of H(x), in effect a dilation by it; for comparison.

and the features of the voxel are posterior means,

    p(G_k | x) = w_k(x) / sum_j w_j(x),  w_k = N(x; mu_k, Sigma_k) o_k  (integrated: c_k o_k, released: o_k phi_k)   (C)
    f(x)       = sum_k p(G_k | x) f_k                                                                          (D)

H(x) is all k with a Mahalanobis distance of x to G_k of at most the cutoff; what that leaves out is a c_k of less than
exp(-cutoff^2 / 2) each, 0.011 at the default of 3. Integrated: all whose bounding box at the cutoff touches V(x); what
that leaves out is less than 6 Phi(-cutoff) of a Gaussian's mass, 0.008. Released: all whose voxel is, along each axis,
at most ceil(cutoff s_max / voxel) voxels away.

Gaussians that are finer than the lattice can show would fall between the voxels' centres. A deviation s_ki below a
given s_min becomes s_min, and phi_k is multiplied by (prod_i s_ki / max(s_ki, s_min))^(2/3), the areas' ratio, so that
what a surface of Gaussians adds up to stays as it is. Such a limit is Mip-Splatting's (Z. Yu et al., CVPR 2024, Sec.
5.1); that its weight goes with the area is due to occupancy, whose Gaussians stand side by side on surfaces.
"""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numba import njit, prange, types
from numba.extending import overload
from numpy.typing import NDArray

from ..core.half_floats import widen_halves
from ..core.hash_table import build_table, find_row, packed_key
from ..core.threads import count_threads
from ..core.types import BLOCK, Gaussians
from ..settings.stages import OccupancyOptions as Options
from .gaussian_mass import integrate_boxes
from .voxel_blocks import find_touched_blocks, unite_keys

_PROBABILISTIC, _POISSON, _INTEGRATED, _RELEASED = range(4)
_MODES = {"probabilistic": _PROBABILISTIC, "poisson": _POISSON, "integrated": _INTEGRATED, "released": _RELEASED}
_SMALLEST_SCALE = 1e-5


@dataclass(frozen=True)
class Bins:
    """Gaussians sorted into the voxel blocks that their neighbourhoods touch.

    packed: (B,) ascending packed block keys.  start: (B + 1,) and gaussian: (P,) list block b's Gaussians as
    ``gaussian[start[b]:start[b + 1]]``.  means: (N, 3) float32 in voxels, relative to the lattice's origin. form: (N,
    6) float32 upper triangle of a matrix: Sigma^-1 in voxels^-2; integrated: Sigma in voxels^2; released: Sigma in
    metres^2, times what turns voxels into metres twice.  lo, hi: (N, 3) int32 first and last voxel of the
    neighbourhood's box.  opacities: (N,) float32.  share: (N,) float32, what phi is multiplied by.  log_weight: (N,)
    float32 log of the part of w_k that is the same at all voxels, up to a common constant.  mode, squared_cutoff: of
    the projection.  device: where they run.
    """

    packed: NDArray[np.int64]
    start: NDArray[np.int64]
    gaussian: NDArray[np.int32]
    means: NDArray[np.float32]
    form: NDArray[np.float32]
    lo: NDArray[np.int32]
    hi: NDArray[np.int32]
    opacities: NDArray[np.float32]
    share: NDArray[np.float32]
    log_weight: NDArray[np.float32]
    mode: int
    squared_cutoff: np.float32
    device: str

    def only(self, packed: NDArray[np.int64]) -> Bins:
        """Those of the blocks whose packed keys are among the given."""
        rows = np.flatnonzero(np.isin(self.packed, packed))
        count = np.diff(self.start)[rows]
        start = np.concatenate(([0], np.cumsum(count)))
        pairs = np.arange(start[-1]) + np.repeat(self.start[rows] - start[:-1], count)
        return replace(self, packed=self.packed[rows], start=start, gaussian=self.gaussian[pairs])


def check(options: Options) -> None:
    """Raises ConfigError or DependencyError if Gaussians cannot be projected on the device that is asked for."""
    if options.device != "cpu":
        from . import splat_torch

        splat_torch.check_device(options.device)


def bin_gaussians(
    gaussians: Gaussians,
    origin: NDArray[np.float64],
    options: Options,
    shape: tuple[int, int, int] | None = None,
    least_scale: float = 0.0,
) -> Bins:
    """Sort Gaussians into blocks of the lattice whose voxel (0, 0, 0) has its lower corner at ``origin``.

    shape: only the voxels (0, 0, 0) … shape - 1 are evaluated, however far a Gaussian reaches; all by default.
    least_scale: s_min, metres.
    """
    check(options)
    mode = _MODES[options.projection]
    scales, share = widen_scales(gaussians.scales, least_scale, options)
    means, form, log_weight, lo, hi = _prepared(
        gaussians.means, scales, gaussians.quats_wxyz, gaussians.opacities, origin, options.voxel_size,
        options.cutoff, mode,
    )  # fmt: skip
    if shape is not None:
        lo, hi = np.maximum(lo, np.int32(0)), np.minimum(hi, np.array(shape, np.int32) - 1)
    packed, start, gaussian = _sort_by_block(lo, hi)
    squared_cutoff = np.float32(np.inf if mode == _RELEASED else options.cutoff**2)
    return Bins(
        packed, start, gaussian, means, form, lo, hi, gaussians.opacities, share, log_weight, mode,
        squared_cutoff, options.device,
    )  # fmt: skip


def widen_scales(
    scales: NDArray[np.float32], least_scale: float, options: Options
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """(N, 3) deviations of at least s_min, metres, and the (N,) shares that the phi are multiplied by. A mass within
    a voxel needs no such thing, nor does what is dilated."""
    if least_scale == 0 or _MODES[options.projection] not in (_PROBABILISTIC, _POISSON):
        return scales, np.ones(len(scales), np.float32)
    wide = np.maximum(scales, np.float32(least_scale))
    return wide, np.asarray((scales / wide).prod(axis=1) ** np.float32(2 / 3), np.float32)


def compute_probability(bins: Bins, keys: NDArray[np.int32]) -> NDArray[np.float32]:
    """(B, 512) alpha at every voxel of the bins' blocks, whose (B, 3) keys are given: equations (A) and (B)."""
    if bins.device != "cpu":
        from . import splat_torch

        return splat_torch.compute_probability_torch(bins, keys, bins.mode != _PROBABILISTIC)
    listed = keys, bins.start, bins.gaussian, bins.means, bins.form, bins.lo, bins.hi
    if bins.mode == _INTEGRATED:
        return _probability_by_mass(*listed)
    return _probability(*listed, bins.opacities, bins.share, bins.squared_cutoff, bins.mode != _PROBABILISTIC)


def compute_posterior_mean(
    bins: Bins, keys: NDArray[np.int32], slots: NDArray[np.int32], values: NDArray[np.floating]
) -> NDArray[np.float32]:
    """(V, D) posterior expectation of per-Gaussian values (N, D) at some voxels: equations (C) and (D).

    slots: (B, 512) row of the output for each voxel of the bins' blocks, -1 for voxels that are not asked for. A voxel
    without a neighbouring Gaussian gets zeros. values: float16 ones are taken as they are, without a copy of all.
    """
    rows = int(slots.max(initial=-1)) + 1
    if bins.device != "cpu":
        from . import splat_torch

        return splat_torch.compute_posterior_mean_torch(bins, keys, slots, values, rows)
    return _posterior_mean(
        keys, bins.start, bins.gaussian, bins.means, bins.form, bins.lo, bins.hi, bins.log_weight, bins.squared_cutoff,
        bins.mode == _INTEGRATED, slots, values.view(np.uint16) if values.dtype == np.float16 else values, rows,
    )  # fmt: skip


@njit(parallel=True, cache=True)
def _prepared(
    world: NDArray[np.float32],
    deviations: NDArray[np.float32],
    quats_wxyz: NDArray[np.float32],
    opacities: NDArray[np.float32],
    origin: NDArray[np.float64],
    size: float,
    cutoff: float,
    mode: int,
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32], NDArray[np.int32], NDArray[np.int32]]:
    """Means, forms, logarithms of weights, first and last voxels, as in ``Bins``; lo > hi if no voxel is near."""
    n = len(world)
    means, form = np.empty((n, 3), np.float32), np.empty((n, 6), np.float32)
    log_weight = np.empty(n, np.float32)
    lo, hi = np.empty((n, 3), np.int32), np.empty((n, 3), np.int32)
    for g in prange(n):
        w, x, y, z = quats_wxyz[g, 0], quats_wxyz[g, 1], quats_wxyz[g, 2], quats_wxyz[g, 3]
        norm = math.sqrt(w * w + x * x + y * y + z * z)
        w, x, y, z = w / norm, x / norm, y / norm, z / norm
        R = (
            (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
            (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
            (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
        )
        s0, s1, s2 = (
            max(deviations[g, 0], _SMALLEST_SCALE) / size,
            max(deviations[g, 1], _SMALLEST_SCALE) / size,
            max(deviations[g, 2], _SMALLEST_SCALE) / size,
        )
        log_weight[g] = math.log(max(opacities[g], 1e-6))
        d0, d1, d2 = s0 * s0, s1 * s1, s2 * s2
        if mode in (_PROBABILISTIC, _POISSON):
            d0, d1, d2 = 1 / d0, 1 / d1, 1 / d2
            log_weight[g] -= math.log(s0 * s1 * s2)
        elif mode == _RELEASED:
            d0, d1, d2 = d0 * size**4, d1 * size**4, d2 * size**4
        dilation = math.ceil(cutoff * max(s0, s1, s2))
        entry = 0
        for i in range(3):
            a = R[i]
            for j in range(i, 3):
                b = R[j]
                form[g, entry] = a[0] * b[0] * d0 + a[1] * b[1] * d1 + a[2] * b[2] * d2
                entry += 1
            mean = np.float32((world[g, i] - origin[i]) / size)
            means[g, i] = mean
            reach = cutoff * math.sqrt((a[0] * s0) ** 2 + (a[1] * s1) ** 2 + (a[2] * s2) ** 2)
            if mode == _RELEASED:
                lo[g, i], hi[g, i] = math.floor(mean) - dilation, math.floor(mean) + dilation
            elif mode == _INTEGRATED:  # any part of the voxel
                lo[g, i], hi[g, i] = math.floor(mean - reach), math.floor(mean + reach)
            else:  # its centre
                lo[g, i], hi[g, i] = math.ceil(mean - reach - 0.5), math.floor(mean + reach - 0.5)
    return means, form, log_weight, lo, hi


def _sort_by_block(
    lo: NDArray[np.int32], hi: NDArray[np.int32]
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int32]]:
    """Counting sort of the (Gaussian, block) pairs: the blocks' packed keys, where each block's Gaussians start, and
    the Gaussians. Each thread sorts a part of the Gaussians; the parts keep their order, so that the result is the
    same with any number of threads."""
    bounds = np.linspace(0, len(lo), count_threads() + 1).astype(int)
    parts = [slice(first, end) for first, end in pairwise(bounds)]
    with ThreadPoolExecutor(len(parts)) as threads:
        packed = unite_keys(*threads.map(lambda part: find_touched_blocks(lo[part], hi[part]), parts))
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
                    count[find_row(table, rows, packed_key(i, j, k))] += 1
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
                    b = find_row(table, rows, packed_key(i, j, k))
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
    opacities: NDArray[np.float32],
    share: NDArray[np.float32],
    squared_cutoff: np.float32,
    poisson: bool,
) -> NDArray[np.float32]:
    alpha = np.empty((len(keys), BLOCK**3), np.float32)
    one, two, half = np.float32(1), np.float32(2), np.float32(0.5)
    for b in prange(len(keys)):
        x0, y0, z0 = keys[b, 0] * BLOCK, keys[b, 1] * BLOCK, keys[b, 2] * BLOCK
        survival = np.ones(BLOCK**3, np.float32)
        for pair in range(start[b], start[b + 1]):
            g = gaussian[pair]
            pxx, pxy, pxz = precision[g, 0], precision[g, 1], precision[g, 2]
            pyy, pyz, pzz = precision[g, 3], precision[g, 4], precision[g, 5]
            for i in range(max(lo[g, 0] - x0, 0), min(hi[g, 0] - x0, BLOCK - 1) + 1):
                dx = np.float32(x0 + i) + half - means[g, 0]
                for j in range(max(lo[g, 1] - y0, 0), min(hi[g, 1] - y0, BLOCK - 1) + 1):
                    dy = np.float32(y0 + j) + half - means[g, 1]
                    constant = dx * (pxx * dx + two * pxy * dy) + pyy * dy * dy
                    linear = two * (pxz * dx + pyz * dy)
                    for k in range(max(lo[g, 2] - z0, 0), min(hi[g, 2] - z0, BLOCK - 1) + 1):
                        dz = np.float32(z0 + k) + half - means[g, 2]
                        squared = constant + dz * (linear + pzz * dz)
                        if squared <= squared_cutoff:
                            phi = share[g] * math.exp(-half * squared)
                            left = math.exp(-opacities[g] * phi) if poisson else one - phi  # (A)
                            survival[(i * BLOCK + j) * BLOCK + k] *= left
        for voxel in range(BLOCK**3):
            alpha[b, voxel] = one - survival[voxel]  # (B)
    return alpha


@njit(parallel=True, cache=True)
def _probability_by_mass(
    keys: NDArray[np.int32],
    start: NDArray[np.int64],
    gaussian: NDArray[np.int32],
    means: NDArray[np.float32],
    covariance: NDArray[np.float32],
    lo: NDArray[np.int32],
    hi: NDArray[np.int32],
) -> NDArray[np.float32]:
    alpha = np.empty((len(keys), BLOCK**3), np.float32)
    for b in prange(len(keys)):
        survival, mass = np.ones(BLOCK**3), np.empty((BLOCK, BLOCK, BLOCK))
        for pair in range(start[b], start[b + 1]):
            g = gaussian[pair]
            i0, j0, k0, i1, j1, k1 = _window(keys[b], lo[g], hi[g])
            integrate_boxes(means[g], covariance[g], keys[b], i0, j0, k0, i1, j1, k1, mass)
            for i in range(i0, i1):
                for j in range(j0, j1):
                    for k in range(k0, k1):
                        survival[(i * BLOCK + j) * BLOCK + k] *= 1.0 - mass[i, j, k]
        for voxel in range(BLOCK**3):
            alpha[b, voxel] = 1.0 - survival[voxel]  # (B)
    return alpha


@njit(cache=True)
def _window(
    key: NDArray[np.int32], lo: NDArray[np.int32], hi: NDArray[np.int32]
) -> tuple[int, int, int, int, int, int]:
    """First voxel, and the one after the last, of a Gaussian's neighbourhood within a block."""
    x0, y0, z0 = key[0] * BLOCK, key[1] * BLOCK, key[2] * BLOCK
    return (
        max(lo[0] - x0, 0), max(lo[1] - y0, 0), max(lo[2] - z0, 0),
        min(hi[0] - x0 + 1, BLOCK), min(hi[1] - y0 + 1, BLOCK), min(hi[2] - z0 + 1, BLOCK),
    )  # fmt: skip


def _load(values: NDArray[np.generic], g: int, bits: NDArray[np.int32], row: NDArray[np.float32]) -> None:
    """Row g of the values as float32. bits: the memory of ``row``."""


@overload(_load)
def _load_of_kind(values, g, bits, row):  # type: ignore[no-untyped-def]
    def halves(values, g, bits, row):  # type: ignore[no-untyped-def]
        widen_halves(values[g], bits, row)

    def floats(values, g, bits, row):  # type: ignore[no-untyped-def]
        for d in range(len(row)):
            row[d] = values[g, d]

    return halves if values.dtype == types.uint16 else floats


@njit(parallel=True, cache=True)
def _posterior_mean(
    keys: NDArray[np.int32],
    start: NDArray[np.int64],
    gaussian: NDArray[np.int32],
    means: NDArray[np.float32],
    form: NDArray[np.float32],
    lo: NDArray[np.int32],
    hi: NDArray[np.int32],
    log_weight: NDArray[np.float32],
    squared_cutoff: np.float32,
    by_mass: bool,
    slots: NDArray[np.int32],
    values: NDArray[np.floating],
    rows: int,
) -> NDArray[np.float32]:
    dimension = values.shape[1]
    mean = np.zeros((rows, dimension), np.float32)
    two, half = np.float32(2), np.float32(0.5)
    for b in prange(len(keys)):
        x0, y0, z0 = keys[b, 0] * BLOCK, keys[b, 1] * BLOCK, keys[b, 2] * BLOCK
        total, mass = np.zeros(BLOCK**3, np.float32), np.empty((BLOCK, BLOCK, BLOCK))
        bits = np.empty(dimension, np.int32)
        own = bits.view(np.float32)
        # Densities of thin and of wide Gaussians differ by orders of magnitude: the block's largest is the unit.
        unit = np.float32(-np.inf)
        for pair in range(start[b], start[b + 1]):
            unit = max(unit, log_weight[gaussian[pair]])
        for pair in range(start[b], start[b + 1]):
            g = gaussian[pair]
            fxx, fxy, fxz, fyy, fyz, fzz = form[g, 0], form[g, 1], form[g, 2], form[g, 3], form[g, 4], form[g, 5]
            i0, j0, k0, i1, j1, k1 = _window(keys[b], lo[g], hi[g])
            loaded = False
            if by_mass:
                integrate_boxes(means[g], form[g], keys[b], i0, j0, k0, i1, j1, k1, mass)
            for i in range(i0, i1):
                dx = np.float32(x0 + i) + half - means[g, 0]
                for j in range(j0, j1):
                    dy = np.float32(y0 + j) + half - means[g, 1]
                    constant = dx * (fxx * dx + two * fxy * dy) + fyy * dy * dy
                    linear = two * (fxz * dx + fyz * dy)
                    for k in range(k0, k1):
                        voxel = (i * BLOCK + j) * BLOCK + k
                        row = slots[b, voxel]
                        if row < 0:
                            continue
                        if by_mass:
                            weight = np.float32(mass[i, j, k] * math.exp(log_weight[g] - unit))  # (C), numerator
                        else:
                            dz = np.float32(z0 + k) + half - means[g, 2]
                            squared = constant + dz * (linear + fzz * dz)
                            if squared > squared_cutoff:
                                continue
                            weight = np.float32(math.exp(-half * squared + log_weight[g] - unit))  # (C), numerator
                        total[voxel] += weight
                        if not loaded:
                            _load(values, g, bits, own)
                            loaded = True
                        for d in range(dimension):
                            mean[row, d] += weight * own[d]  # (D)
        for voxel in range(BLOCK**3):
            row = slots[b, voxel]
            if row >= 0 and total[voxel] > 0:
                for d in range(dimension):
                    mean[row, d] /= total[voxel]  # (C), denominator
    return mean
