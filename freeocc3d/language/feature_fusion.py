"""Features of Gaussians from many views: a weighted mean, without the parts of views that the other views contradict.

    f_k = sum_t w_t z_t(u_t) / |sum_t w_t z_t(u_t)|,   u_t the pixel of mu_k in keyframe t,

with the weights of ``visibility``. Encoders err by things, not by pixels: what a network takes for something else it
takes so over the whole of it. So agreement is judged by regions of a view, connected cells of like features. A region's
disagreement is the mean of 1 - cos(z_t(u_t), f_k without view t) over the Gaussians in it that other views show,
in units of what two random places of the scene differ by, 1 - |mean f|^2: 0 is agreement, 1 no more of it than by
chance, for any encoder. Regions beyond ``disagreement`` are taken out, with what no other view shows in them: of a wall
that is mistaken, also the part that is seen once. But of views that all contradict each other, the one that does so
least stays: what is mistaken differently each time does not take with it what is right most often.

The regions are judged by all views and taken out together, the worst first, so that the order of views matters only to
rounding.
"""

from __future__ import annotations

import math
import tempfile
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from ..core.half_floats import widen_halves
from ..core.union_find import find_root, join_sets
from .visibility import VisibleGaussians

_ALIKE = 0.9
"""Least cosine of neighbouring cells' features that belong to one region."""
_SAME = 0.9995
"""Least cosine of cells of a region whose features are kept as one."""
_FIRST = 1.0
"""The disagreement beyond which regions are taken out first: where several views are wrong, those that are right are
contradicted, too, until the worst are out."""
_ROUNDS = 2  # after that
_NOTHING_LEFT = 1e-3
"""Share of a Gaussian's weight, below which all of its views are taken out: what remains is rounding."""
_TIED = 1e-3
"""Regions whose disagreement differs by less are contradicted equally."""
_IN_MEMORY = 512 << 20
"""Bytes of views' codes that are kept in memory; more are kept in a temporary file."""
_LEAST_CONTRAST = 0.05
"""Of a scene that looks the same everywhere: differences below this share of it are noise."""


@dataclass
class _View:
    """What is kept of a view, to be able to take parts of it out.

    rows: (M,) int32 of the Gaussians that it has something to say of.  slots: (M,) int32, row of ``codes``.
    weights: (M,) float32.  codes, scales: (U, D) int8 and (U,) float32, the features that any of them has: codes *
    scales is of unit length.  region: (U,) int32.  kept: (R,) bool, which regions are in the sum.
    """

    rows: NDArray[np.int32]
    slots: NDArray[np.int32]
    weights: NDArray[np.float32]
    codes: NDArray[np.int8]
    scales: NDArray[np.float32]
    region: NDArray[np.int32]
    kept: NDArray[np.bool_]


class FeatureFusion:
    """Running weighted mean of the features of N Gaussians over views that come one by one.

    Memory: 4 D + 4 bytes a Gaussian (float32 ``sum`` (N, D) and ``weights`` (N,)); and of each view, unless all are
    kept, 12 bytes a Gaussian that it shows and D + 8 a feature, which all Gaussians on like cells of a region share.
    Features of many views, beyond 512 MB, lie in a temporary file.
    disagreement: see above; None keeps all.
    """

    def __init__(self, n_gaussians: int, dimension: int, disagreement: float | None = None):
        self.disagreement = disagreement
        self.sum = np.zeros((n_gaussians, dimension), np.float32)
        self.weights = np.zeros(n_gaussians, np.float32)
        self._views: list[_View] = []
        self._in_memory = 0
        self._file: Any = None

    def add(self, seen: VisibleGaussians, features: NDArray[np.float16]) -> None:
        """Fuse the (h, w, D) features of a frame that shows ``seen``; their lengths are weights, zeros say nothing."""
        h, w, dimension = features.shape
        cells = _widened(np.ascontiguousarray(features, np.float16).view(np.uint16))
        first, shared = _regions(cells, np.float32(_ALIKE), np.float32(_SAME))
        cells, own = cells.reshape(h * w, dimension), seen.cells((h, w))
        length = np.sqrt(np.einsum("cd,cd->c", cells, cells))
        says = length[own] > 0
        rows, own = seen.rows[says], own[says]
        weights = seen.weights[says] * length[own]
        own = shared[own]
        _add(rows, own, weights, cells, 1 / np.where(length > 0, length, 1), self.sum, self.weights)
        if self.disagreement is None or not len(rows):
            return
        used = np.flatnonzero(np.bincount(own, minlength=h * w))
        slot_of = np.empty(h * w, np.int32)
        slot_of[used] = np.arange(len(used))
        region = np.unique(first[used], return_inverse=True)[1].astype(np.int32)
        kept = np.ones(int(region.max()) + 1, bool)
        codes, scales = _coded(cells, used)
        codes = self._stowed(codes)
        self._views.append(_View(rows, slot_of[own], weights, codes, scales, region, kept))

    def _stowed(self, codes: NDArray[np.int8]) -> NDArray[np.int8]:
        """The same codes, in a file that has no name if there are many already. Raises OSError: the disk is full."""
        self._in_memory += codes.nbytes
        if self._in_memory <= _IN_MEMORY:
            return codes
        self._in_memory -= codes.nbytes
        if self._file is None:
            self._file = tempfile.TemporaryFile(prefix="freeocc3d-")  # noqa: SIM115 - it is open as long as it is mapped
        start = self._file.seek(0, 2)
        self._file.write(codes.tobytes())
        self._file.flush()
        return np.asarray(np.memmap(self._file, np.int8, "r", start, codes.shape))

    def features(self) -> NDArray[np.float16]:
        """(N, D) unit features; zero for a Gaussian that no view had anything to say of that others bear out."""
        for view in self._views:
            self._keep(view, np.ones_like(view.kept))
        little = _NOTHING_LEFT * self.weights
        for limit in self._limits():
            most = limit * self._contrast()
            off = [self._disagreement(view, little) for view in self._views]
            least = self._least(off)
            judged = [self._agreeing(view, own, least, most) for view, own in zip(self._views, off, strict=True)]
            for view, kept in zip(self._views, judged, strict=True):
                self._keep(view, kept)
        norms = np.linalg.norm(self.sum, axis=1)
        norms[(self.weights <= little) | (norms == 0)] = np.inf
        return (self.sum / norms[:, None]).astype(np.float16)

    def _limits(self) -> list[float]:
        """Of the disagreement, in the rounds of judging."""
        limit = self.disagreement
        return [] if limit is None else [max(_FIRST, limit), *_ROUNDS * [limit]]

    def _contrast(self) -> float:
        """1 - |mean f|^2: how much two Gaussians' features differ on average."""
        norms = np.linalg.norm(self.sum, axis=1)
        known = norms > 0
        mean = (known / np.where(known, norms, 1)).astype(np.float32) @ self.sum / max(np.count_nonzero(known), 1)
        return max(1.0 - float(mean @ mean), _LEAST_CONTRAST)

    def _disagreement(self, view: _View, little: NDArray[np.float32]) -> NDArray[np.float32]:
        """(R,) mean of 1 - cosine of each of the view's regions with the other views, NaN where no other view shows any
        of it. little: (N,) weights that are rounding."""
        own = np.where(view.kept[view.region[view.slots]], view.weights, np.float32(0))
        cosine = _agreement(view.rows, view.slots, own, view.codes, view.scales, self.sum, self.weights - little)
        other = np.isfinite(cosine)
        region, count = view.region[view.slots[other]], len(view.kept)
        shown = np.bincount(region, minlength=count)
        off = np.bincount(region, 1.0 - cosine[other], count)
        return np.where(shown > 0, off / np.maximum(shown, 1), np.nan).astype(np.float32)

    def _least(self, off: list[NDArray[np.float32]]) -> NDArray[np.float32]:
        """(N,) least disagreement of the regions that show each Gaussian; infinite where only one does."""
        least, views = np.full(len(self.weights), np.inf, np.float32), np.zeros(len(self.weights), np.int32)
        for view, own in zip(self._views, off, strict=True):
            least[view.rows] = np.fmin(least[view.rows], own[view.region[view.slots]])
            views[view.rows] += 1
        least[views < 2] = np.inf
        return least

    def _agreeing(
        self, view: _View, off: NDArray[np.float32], least: NDArray[np.float32], most: float
    ) -> NDArray[np.bool_]:
        """(R,) the view's regions that the other views do not contradict, or not more than any other region at half of
        the Gaussians that others show; those that no other view shows are kept. most: mean of 1 - cosine."""
        region, least = view.region[view.slots], least[view.rows]
        rivalled = np.bincount(region, np.isfinite(least), len(off))
        best = np.bincount(region, np.isfinite(least) & (off[region] <= least + _TIED), len(off))
        return np.asarray(~(off > most) | (2 * best >= rivalled))

    def _keep(self, view: _View, kept: NDArray[np.bool_]) -> None:
        """Take regions out of the sum, or back in."""
        change = kept.astype(np.float32) - view.kept
        if change.any():
            step = change[view.region[view.slots]]
            moved = np.flatnonzero(step)
            rows, slots, weights = view.rows[moved], view.slots[moved], step[moved] * view.weights[moved]
            _add(rows, slots, weights, view.codes, view.scales, self.sum, self.weights)
        view.kept = kept


@njit(parallel=True, cache=True)
def _widened(halves: NDArray[np.uint16]) -> NDArray[np.float32]:
    """The float32 of finite float16 (h, w, D), given by their bits."""
    bits = np.empty(halves.shape, np.int32)
    wide = bits.view(np.float32)
    for row in prange(halves.shape[0]):
        for column in range(halves.shape[1]):
            widen_halves(halves[row, column], bits[row, column], wide[row, column])
    return wide


@njit(cache=True, fastmath=True)
def _alike(a: NDArray[np.float32], b: NDArray[np.float32], least: np.float32) -> bool:
    dot, squared_a, squared_b = np.float32(0), np.float32(0), np.float32(0)
    for d in range(len(a)):
        dot += a[d] * b[d]
        squared_a += a[d] * a[d]
        squared_b += b[d] * b[d]
    return bool(dot > 0 and dot * dot >= least * least * squared_a * squared_b)


@njit(parallel=True, cache=True)
def _regions(
    features: NDArray[np.float32], alike: np.float32, same: np.float32
) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Of each cell of (h, w, D) features, row by row: the first cell of its connected region of like features, and the
    cell whose direction it shares, which is that one or itself. A zero feature is a region of its own."""
    h, w, _ = features.shape
    left, above = np.zeros((h, w), np.bool_), np.zeros((h, w), np.bool_)
    for row in prange(h):
        for column in range(w):
            left[row, column] = column and _alike(features[row, column], features[row, column - 1], alike)
            above[row, column] = row and _alike(features[row, column], features[row - 1, column], alike)
    first = _first_connected(left, above)
    shared = np.empty(h * w, np.int32)
    for cell in prange(h * w):
        to = first[cell]
        is_same = _alike(features[cell // w, cell % w], features[to // w, to % w], same)
        shared[cell] = to if is_same else cell
    return first, shared


@njit(cache=True)
def _first_connected(left: NDArray[np.bool_], above: NDArray[np.bool_]) -> NDArray[np.int32]:
    """(h * w,) first cell of each one's connected region, given which are connected to the left and above."""
    h, w = left.shape
    parent = np.arange(h * w).astype(np.int32)
    for row in range(h):
        for column in range(w):
            here = row * w + column
            if left[row, column]:
                join_sets(parent, here, here - 1)
            if above[row, column]:
                join_sets(parent, here, here - w)
    for cell in range(h * w):
        parent[cell] = find_root(parent, cell)
    return parent


@njit(parallel=True, cache=True, fastmath={"reassoc", "contract"})
def _coded(features: NDArray[np.float32], used: NDArray[np.int64]) -> tuple[NDArray[np.int8], NDArray[np.float32]]:
    """Some rows of (C, D) features, none of them zero, as (U, D) int8 and the (U,) factors that make unit features of
    these."""
    codes, scales = np.empty((len(used), features.shape[1]), np.int8), np.empty(len(used), np.float32)
    for n in prange(len(used)):
        own = features[used[n]]
        largest, squared = np.float32(0), np.float32(0)
        for d in range(len(own)):
            largest = max(largest, abs(own[d]))
        for d in range(len(own)):
            level = np.rint(own[d] * (np.float32(127) / largest))
            codes[n, d] = np.int8(level)
            squared += level * level
        scales[n] = 1 / math.sqrt(squared)
    return codes, scales


@njit(parallel=True, cache=True)
def _add(
    rows: NDArray[np.int32],
    slots: NDArray[np.int32],
    weight: NDArray[np.float32],
    features: NDArray[np.generic],
    scales: NDArray[np.float32],
    total: NDArray[np.float32],
    weights: NDArray[np.float32],
) -> None:
    """total[rows] += weight * scales[slots] * features[slots]; no row occurs twice."""
    for n in prange(len(rows)):
        g, own = rows[n], features[slots[n]]
        factor = weight[n] * scales[slots[n]]
        for d in range(total.shape[1]):
            total[g, d] += factor * np.float32(own[d])
        weights[g] += weight[n]


@njit(parallel=True, cache=True, fastmath={"reassoc", "contract"})
def _agreement(
    rows: NDArray[np.int32],
    slots: NDArray[np.int32],
    weight: NDArray[np.float32],
    features: NDArray[np.int8],
    scales: NDArray[np.float32],
    total: NDArray[np.float32],
    weights: NDArray[np.float32],
) -> NDArray[np.float32]:
    """(M,) cosine of each unit feature scales * features with the sum without it; NaN where no weight is left then."""
    cosine = np.full(len(rows), np.float32(np.nan), np.float32)
    for n in prange(len(rows)):
        g, own = rows[n], features[slots[n]]
        if weights[g] <= weight[n]:
            continue
        dot, squared, scale = np.float32(0), np.float32(0), scales[slots[n]]
        factor = weight[n] * scale
        for d in range(total.shape[1]):
            feature = np.float32(own[d])
            other = total[g, d] - factor * feature
            dot += feature * other
            squared += other * other
        if squared > 0:
            cosine[n] = scale * dot / np.float32(math.sqrt(squared))
    return cosine
