"""Projects binned Gaussians onto voxels, compiled, one block per thread; ``splat`` has the equations."""

from __future__ import annotations

import math

import numpy as np
from numba import prange, types
from numba.extending import overload
from numpy.typing import NDArray

from ..core.compiling import njit
from ..core.half_floats import widen_halves
from ..core.types import BLOCK
from .gaussian_mass import count_points, measure_boxes


@njit(parallel=True, cache=True)
def splat_probability(
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
def splat_mass(
    keys: NDArray[np.int32],
    start: NDArray[np.int64],
    gaussian: NDArray[np.int32],
    means: NDArray[np.float32],
    covariance: NDArray[np.float32],
    lo: NDArray[np.int32],
    hi: NDArray[np.int32],
    share: NDArray[np.float32],
) -> NDArray[np.float32]:
    alpha = np.empty((len(keys), BLOCK**3), np.float32)
    for b in prange(len(keys)):
        survival, mass = np.ones(BLOCK**3), np.empty((BLOCK, BLOCK, BLOCK))
        for pair in range(start[b], start[b + 1]):
            g = gaussian[pair]
            i0, j0, k0, i1, j1, k1 = _window(keys[b], lo[g], hi[g])
            count = count_points(lo[g], hi[g])
            measure_boxes(means[g], covariance[g], count, keys[b], (i0, j0, k0), (i1, j1, k1), mass)
            for i in range(i0, i1):
                for j in range(j0, j1):
                    for k in range(k0, k1):
                        if mass[i, j, k] > 0:
                            survival[(i * BLOCK + j) * BLOCK + k] *= max(1.0 - mass[i, j, k], 0.0) ** share[g]
        for voxel in range(BLOCK**3):
            alpha[b, voxel] = 1.0 - survival[voxel]  # (B)
    return alpha


@njit(cache=True)
def _window(
    key: NDArray[np.int32], lo: NDArray[np.int32], hi: NDArray[np.int32]
) -> tuple[int, int, int, int, int, int]:
    """Returns the first voxel of a Gaussian's neighborhood within a block, and the voxel after the last."""
    x0, y0, z0 = key[0] * BLOCK, key[1] * BLOCK, key[2] * BLOCK
    return (
        max(lo[0] - x0, 0), max(lo[1] - y0, 0), max(lo[2] - z0, 0),
        min(hi[0] - x0 + 1, BLOCK), min(hi[1] - y0 + 1, BLOCK), min(hi[2] - z0 + 1, BLOCK),
    )  # fmt: skip


def _load(values: NDArray[np.generic], g: int, bits: NDArray[np.int32], row: NDArray[np.float32]) -> None:
    """Loads row g of the values as float32 into ``row``. bits: the memory of ``row``."""


@overload(_load)
def _load_of_kind(values, g, bits, row):  # type: ignore[no-untyped-def]
    def halves(values, g, bits, row):  # type: ignore[no-untyped-def]
        widen_halves(values[g], bits, row)

    def floats(values, g, bits, row):  # type: ignore[no-untyped-def]
        for d in range(len(row)):
            row[d] = values[g, d]

    return halves if values.dtype == types.uint16 else floats


@njit(parallel=True, cache=True)
def splat_posterior_mean(
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
        # Densities of thin and wide Gaussians differ by orders of magnitude: the unit is the block's largest.
        unit = np.float32(-np.inf)
        for pair in range(start[b], start[b + 1]):
            unit = max(unit, log_weight[gaussian[pair]])
        for pair in range(start[b], start[b + 1]):
            g = gaussian[pair]
            fxx, fxy, fxz, fyy, fyz, fzz = form[g, 0], form[g, 1], form[g, 2], form[g, 3], form[g, 4], form[g, 5]
            i0, j0, k0, i1, j1, k1 = _window(keys[b], lo[g], hi[g])
            loaded = False
            if by_mass:
                count = count_points(lo[g], hi[g])
                measure_boxes(means[g], form[g], count, keys[b], (i0, j0, k0), (i1, j1, k1), mass)
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
                            if mass[i, j, k] == 0:
                                continue
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
