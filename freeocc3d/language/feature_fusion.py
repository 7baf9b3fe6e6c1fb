"""Fuses features of Gaussians from many views: a weighted mean without the parts of views that other views contradict.

    f_k = sum_t w_t z_t(u_t) / |sum_t w_t z_t(u_t)|,   u_t the pixel of mu_k in keyframe t,

with the weights of ``visibility``. Encoders make mistakes by things, not by pixels: a network that takes a thing for
another does so over the whole thing. So agreement is judged by regions of a view, which are connected cells with
similar features. A region's disagreement is the mean of 1 - cos(z_t(u_t), f_k without view t) over its Gaussians that
other views show, in units of the difference between two random places of the scene, 1 - |mean f|^2. For any encoder, 0
is agreement, and 1 is agreement no better than chance. Regions above ``disagreement`` are removed, including what no
other view shows of them, such as the part of a wrongly named wall that is seen once. If all views of a place contradict
each other, the one that does so least stays. So mistakes that differ from view to view do not remove the most frequent
right result.

All views judge the regions, and the regions are removed together, the worst first. So the order of views affects only
rounding.
"""

from __future__ import annotations

import math
import tempfile
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import prange
from numpy.typing import NDArray

from ..core.compiling import njit
from ..core.dot_products import sum_products
from ..core.half_floats import widen_halves
from ..core.union_find import find_root, join_sets
from .visibility import VisibleGaussians

_ALIKE = 0.9
"""Smallest cosine of the features of neighboring cells in one region."""
_SAME = 0.9995
"""Smallest cosine of cells of a region that share one stored feature."""
_FIRST = 1.0
"""Regions with more disagreement than this are removed first: where several views are wrong, they contradict the right
ones, too, until the worst are removed."""
_ROUNDS = 2  # after the first
_NOTHING_LEFT = 1e-3
"""If all views of a Gaussian are removed, less than this share of its weight remains, from rounding."""
_TIED = 1e-3
"""Regions whose disagreement differs by less than this are equal."""
_LARGEST_CODE = 127
"""Code of a feature's largest component. Codes are int8, so other components are off by at most half a step."""
_IN_MEMORY = 512 << 20
"""Codes of views up to this many bytes are kept in memory; others are kept in a temporary file."""
_LEAST_CONTRAST = 0.05
"""Smallest difference between random places: in a scene that looks the same everywhere, smaller differences are
noise."""


@dataclass
class _View:
    """The data of a view that are needed to remove parts of it.

    rows: (M,) int32 the Gaussians that it gives features for.  slots: (M,) int32, row of ``codes``.
    weights: (M,) float32.  codes, scales: (U, D) int8 and (U,) float32, the distinct features; codes * scales has unit
    length.  region: (U,) int32.  kept: (R,) bool, which regions are in the sum.
    """

    rows: NDArray[np.int32]
    slots: NDArray[np.int32]
    weights: NDArray[np.float32]
    codes: NDArray[np.int8]
    scales: NDArray[np.float32]
    region: NDArray[np.int32]
    kept: NDArray[np.bool_]


class FeatureFusion:
    """Running weighted mean of the features of N Gaussians over views that are added one by one.

    Memory: 4 D + 4 bytes per Gaussian (float32 ``sum`` (N, D) and ``weights`` (N,)). Unless all regions are kept, each
    view also takes 12 bytes per Gaussian that it shows, and D + 8 per feature; all Gaussians on similar cells of a
    region share a feature. Codes beyond 512 MB are in a temporary file.
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
        """Adds the (h, w, D) features of a frame that shows ``seen``; their lengths are weights, zeros have no
        effect."""
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
        """Returns the codes; if there are already many, in an unnamed file. Raises OSError if the disk is full."""
        self._in_memory += codes.nbytes
        if self._in_memory <= _IN_MEMORY:
            return codes
        self._in_memory -= codes.nbytes
        if self._file is None:
            self._file = tempfile.TemporaryFile(prefix="freeocc3d-")  # noqa: SIM115 - stays open while it is mapped
        start = self._file.seek(0, 2)
        self._file.write(codes.tobytes())
        self._file.flush()
        return np.asarray(np.memmap(self._file, np.int8, "r", start, codes.shape))

    def features(self) -> NDArray[np.float16]:
        """(N, D) unit features; zero for a Gaussian for which no view has a feature that the other views confirm."""
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
        """The limits of the disagreement, one for each round."""
        limit = self.disagreement
        return [] if limit is None else [max(_FIRST, limit), *_ROUNDS * [limit]]

    def _contrast(self) -> float:
        """1 - |mean f|^2: how much two Gaussians' features differ on average."""
        norms = np.linalg.norm(self.sum, axis=1)
        known = norms > 0
        mean = (known / np.where(known, norms, 1)).astype(np.float32) @ self.sum / max(np.count_nonzero(known), 1)
        return max(1.0 - float(mean @ mean), _LEAST_CONTRAST)

    def _disagreement(self, view: _View, little: NDArray[np.float32]) -> NDArray[np.float32]:
        """(R,) mean of 1 - cosine of each region of the view with the other views; NaN if no other view shows any of
        it. little: (N,) weights that are only rounding."""
        own = np.where(view.kept[view.region[view.slots]], view.weights, np.float32(0))
        cosine = _agreement(view.rows, view.slots, own, view.codes, view.scales, self.sum, self.weights - little)
        other = np.isfinite(cosine)
        region, count = view.region[view.slots[other]], len(view.kept)
        shown = np.bincount(region, minlength=count)
        off = np.bincount(region, 1.0 - cosine[other], count)
        return np.where(shown > 0, off / np.maximum(shown, 1), np.nan).astype(np.float32)

    def _least(self, off: list[NDArray[np.float32]]) -> NDArray[np.float32]:
        """(N,) least disagreement of the regions that show each Gaussian; infinite if only one does."""
        least, views = np.full(len(self.weights), np.inf, np.float32), np.zeros(len(self.weights), np.int32)
        for view, own in zip(self._views, off, strict=True):
            least[view.rows] = np.fmin(least[view.rows], own[view.region[view.slots]])
            views[view.rows] += 1
        least[views < 2] = np.inf
        return least

    def _agreeing(
        self, view: _View, off: NDArray[np.float32], least: NDArray[np.float32], most: float
    ) -> NDArray[np.bool_]:
        """(R,) the regions of the view to keep: the other views do not contradict them, or contradict the other regions
        no less at half of the Gaussians that others show, or no other view shows them. most: mean of 1 - cosine."""
        region, least = view.region[view.slots], least[view.rows]
        rivalled = np.bincount(region, np.isfinite(least), len(off))
        best = np.bincount(region, np.isfinite(least) & (off[region] <= least + _TIED), len(off))
        return np.asarray(~(off > most) | (2 * best >= rivalled))

    def _keep(self, view: _View, kept: NDArray[np.bool_]) -> None:
        """Removes regions from the sum, or adds them again."""
        change = kept.astype(np.float32) - view.kept
        if change.any():
            step = change[view.region[view.slots]]
            moved = np.flatnonzero(step)
            rows, slots, weights = view.rows[moved], view.slots[moved], step[moved] * view.weights[moved]
            _add(rows, slots, weights, view.codes, view.scales, self.sum, self.weights)
        view.kept = kept


@njit(parallel=True, cache=True)
def _widened(halves: NDArray[np.uint16]) -> NDArray[np.float32]:
    """The float32 of finite float16 (h, w, D), given as their bits."""
    bits = np.empty(halves.shape, np.int32)
    wide = bits.view(np.float32)
    for row in prange(halves.shape[0]):
        for column in range(halves.shape[1]):
            widen_halves(halves[row, column], bits[row, column], wide[row, column])
    return wide


@njit(cache=True)
def _alike(a: NDArray[np.float32], b: NDArray[np.float32], least: np.float32) -> bool:
    dot = sum_products(a, b)
    return bool(dot > 0 and dot * dot >= least * least * sum_products(a, a) * sum_products(b, b))


@njit(parallel=True, cache=True)
def _regions(
    features: NDArray[np.float32], alike: np.float32, same: np.float32
) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """For each cell of (h, w, D) features, row by row: the first cell of its connected region of similar features, and
    the cell whose direction it shares, which is that first cell or itself. A zero feature is a region of its own."""
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
    """(h * w,) first cell of the connected region of each cell, given which cells are connected to the left and
    above."""
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


@njit(parallel=True, cache=True)
def _coded(features: NDArray[np.float32], used: NDArray[np.int64]) -> tuple[NDArray[np.int8], NDArray[np.float32]]:
    """Encodes nonzero rows of (C, D) features as (U, D) int8 and (U,) factors that give unit features."""
    codes, scales = np.empty((len(used), features.shape[1]), np.int8), np.empty(len(used), np.float32)
    for n in prange(len(used)):
        own = features[used[n]]
        largest, levels = np.float32(0), np.empty_like(own)
        for d in range(len(own)):
            largest = max(largest, abs(own[d]))
        for d in range(len(own)):
            levels[d] = np.rint(own[d] * (np.float32(_LARGEST_CODE) / largest))
            codes[n, d] = np.int8(levels[d])
        scales[n] = 1 / math.sqrt(sum_products(levels, levels))
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


@njit(parallel=True, cache=True)
def _agreement(
    rows: NDArray[np.int32],
    slots: NDArray[np.int32],
    weight: NDArray[np.float32],
    features: NDArray[np.int8],
    scales: NDArray[np.float32],
    total: NDArray[np.float32],
    weights: NDArray[np.float32],
) -> NDArray[np.float32]:
    """(M,) cosine of each unit feature scales * features with the sum without it; NaN if no weight is left."""
    cosine = np.full(len(rows), np.float32(np.nan), np.float32)
    for n in prange(len(rows)):
        g, own = rows[n], features[slots[n]]
        if weights[g] <= weight[n]:
            continue
        feature, others = np.empty(len(own), np.float32), np.empty(len(own), np.float32)
        scale = scales[slots[n]]
        for d in range(len(own)):
            feature[d] = own[d]
            others[d] = total[g, d] - weight[n] * scale * feature[d]
        squared = sum_products(others, others)
        if squared > 0:
            cosine[n] = scale * sum_products(feature, others) / np.float32(math.sqrt(squared))
    return cosine
