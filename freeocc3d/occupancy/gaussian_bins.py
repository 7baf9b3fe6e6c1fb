"""Sorts Gaussians into the voxel blocks that their neighborhoods touch; ``splat`` has the equations."""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numba import prange
from numpy.typing import NDArray

from ..core.compiling import njit
from ..core.hash_table import build_table, find_row, packed_key
from ..core.threads import count_threads
from ..core.types import BLOCK
from ..core.voxel_keys import KEY_LIMIT
from .voxel_blocks import find_touched_blocks, refuse_blocks, unite_keys

PROBABILISTIC, POISSON, INTEGRATED, RELEASED = range(4)
MODES = {"probabilistic": PROBABILISTIC, "poisson": POISSON, "integrated": INTEGRATED, "released": RELEASED}
"""Names of the projection modes, and their numbers in compiled code."""

SMALLEST_SCALE_M = 1e-5
"""Least standard deviation, meters: its inverse square still fits into float32."""

LEAST_OPACITY = 1e-6
"""Least opacity in the logarithm of a weight: a Gaussian that no image shows has almost no weight."""


_FARTHEST = BLOCK * KEY_LIMIT - BLOCK
"""Voxels from the origin of the farthest ones whose blocks have keys."""


@dataclass(frozen=True)
class Bins:
    """Gaussians, sorted into the voxel blocks that their neighborhoods touch.

    packed: (B,) ascending packed block keys.  start: (B + 1,) and gaussian: (P,) list block b's Gaussians as
    ``gaussian[start[b]:start[b + 1]]``.  means: (N, 3) float32 in voxels, relative to the lattice's origin.  form: (N,
    6) float32 upper triangle of a matrix: Sigma^-1 in voxels^-2; integrated: Sigma in voxels^2; released: Sigma in
    meters^2, times the squared voxel size in meters.  lo, hi: (N, 3) int32 first and last voxel of the neighborhood's
    box.  opacities: (N,) float32.  share: (N,) float32 factor of phi; integrated: a_k.  log_weight: (N,) float32
    logarithm of the part of w_k that is the same at all voxels, up to a common constant.  mode, squared_cutoff: of the
    projection.  device: where the projection runs.
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
        """Returns the blocks whose packed keys are in ``packed``."""
        rows = np.flatnonzero(np.isin(self.packed, packed))
        count = np.diff(self.start)[rows]
        start = np.concatenate(([0], np.cumsum(count)))
        pairs = np.arange(start[-1]) + np.repeat(self.start[rows] - start[:-1], count)
        return replace(self, packed=self.packed[rows], start=start, gaussian=self.gaussian[pairs])


@njit(cache=True)
def _voxel_at_or_below(place: float) -> int:
    return math.floor(min(max(place, -_FARTHEST), _FARTHEST))


@njit(cache=True)
def _voxel_at_or_above(place: float) -> int:
    return math.ceil(min(max(place, -_FARTHEST), _FARTHEST))


@njit(parallel=True, cache=True)
def prepare_gaussians(
    world: NDArray[np.float32],
    deviations: NDArray[np.float32],
    quats_wxyz: NDArray[np.float32],
    opacities: NDArray[np.float32],
    origin: NDArray[np.float64],
    size: float,
    cutoff: float,
    mode: int,
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32], NDArray[np.int32], NDArray[np.int32]]:
    """Returns means, forms, logarithms of weights, first and last voxels as in ``Bins``; lo > hi for an empty box."""
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
            max(deviations[g, 0], SMALLEST_SCALE_M) / size,
            max(deviations[g, 1], SMALLEST_SCALE_M) / size,
            max(deviations[g, 2], SMALLEST_SCALE_M) / size,
        )
        log_weight[g] = math.log(max(opacities[g], LEAST_OPACITY))
        d0, d1, d2 = s0 * s0, s1 * s1, s2 * s2
        if mode in (PROBABILISTIC, POISSON):
            d0, d1, d2 = 1 / d0, 1 / d1, 1 / d2
            log_weight[g] -= math.log(s0 * s1 * s2)
        elif mode == RELEASED:
            d0, d1, d2 = d0 * size**4, d1 * size**4, d2 * size**4
        dilation = _voxel_at_or_above(cutoff * max(s0, s1, s2))
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
            if mode == RELEASED:
                lo[g, i] = max(_voxel_at_or_below(mean) - dilation, -_FARTHEST)
                hi[g, i] = min(_voxel_at_or_below(mean) + dilation, _FARTHEST)
            elif mode == INTEGRATED:  # some part of the voxel
                lo[g, i], hi[g, i] = _voxel_at_or_below(mean - reach), _voxel_at_or_below(mean + reach)
            else:  # its center
                lo[g, i], hi[g, i] = _voxel_at_or_above(mean - reach - 0.5), _voxel_at_or_below(mean + reach - 0.5)
    return means, form, log_weight, lo, hi


def sort_by_block(
    lo: NDArray[np.int32], hi: NDArray[np.int32], voxel_size: float
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int32]]:
    """Sorts the (Gaussian, block) pairs by counting. Returns the blocks' packed keys, the start of each block's
    Gaussians, and the Gaussians. Each thread sorts a part of the Gaussians. The parts keep their order, so the result
    does not depend on the number of threads."""
    bounds = np.linspace(0, len(lo), count_threads() + 1).astype(int)
    parts = [slice(first, end) for first, end in pairwise(bounds)]
    with ThreadPoolExecutor(len(parts)) as threads:
        packed = unite_keys(*threads.map(lambda part: find_touched_blocks(lo[part], hi[part]), parts))
        refuse_blocks(len(packed), voxel_size)
        table, rows = build_table(packed, len(packed))
        count = np.stack(list(threads.map(lambda part: _count(table, rows, lo[part], hi[part], len(packed)), parts)))
        start = np.concatenate(([0], np.cumsum(count.sum(axis=0))))
        place = start[:-1] + np.cumsum(count, axis=0) - count  # start of each part's share of each block
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
    """Returns the (B,) number of this part's Gaussians in each block."""
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
    """Writes this part's Gaussians, numbered from ``first``, at ``place`` (B,), and advances ``place``."""
    for g in range(len(lo)):
        if lo[g, 0] > hi[g, 0] or lo[g, 1] > hi[g, 1] or lo[g, 2] > hi[g, 2]:
            continue
        for i in range(lo[g, 0] >> 3, (hi[g, 0] >> 3) + 1):
            for j in range(lo[g, 1] >> 3, (hi[g, 1] >> 3) + 1):
                for k in range(lo[g, 2] >> 3, (hi[g, 2] >> 3) + 1):
                    b = find_row(table, rows, packed_key(i, j, k))
                    gaussian[place[b]] = first + g
                    place[b] += 1
