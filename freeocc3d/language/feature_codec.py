"""Makes features small by transform coding: a feature keeps its coordinates along the directions in which features vary
most, with 8, 4 or 2 bits each, according to their share of the error. A feature takes no more than 48 bytes, whatever
its dimension.

``tools/benchmark.py --variants voxels`` measures the loss. A low rank with 8 bits throughout and product quantization
lose more at the same size. Source of the steps of the optimal uniform quantizers: J. Max, Quantizing for Minimum
Distortion, IRE Trans. Inf. Theory 6(1), 1960.
"""

from __future__ import annotations

import functools
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..core.errors import MapError
from .word_matching import MANY

MOST_BYTES = 48
"""Largest size of a code in bytes. Features with no more dimensions than this keep their own axes, 8 bits each, so that
values that are never negative decode to exact zeros."""
_BITS = (8, 4, 2)
_STEPS = {4: 0.335, 2: 0.996}  # in standard deviations of a normal distribution (Max, table II)
_ERRORS = {8: 1.0e-4, 4: 0.01154, 2: 0.1188}  # the share of the variance that remains as error
_HARDLY = 1e-4
"""Share of the energy that may be lost without a noticeable effect: 0.00005 of the cosine."""
_NO_WORSE = 1.1
"""A short code may leave up to this many times the energy that the best code leaves."""
_TRIED = np.geomspace(0.5, 2.0, 9)  # steps to try, as multiples of the step for a normal distribution
_TINY = 1e-6  # avoids a step of 0 where all values are equal
_LEVELS = 254
"""8-bit codes 1…255 are levels; a code of zeros is the zero feature, whose meaning is unknown."""
_MARGIN = 0.02
"""Widens an 8-bit range on either side, because a normalized mean of features can be outside the range."""
_ROWS = 8192  # rows in one batch, so that float32 copies of all rows never exist
_ONE_THREAD = 1 << 18  # multiplications of a matrix product that OpenBLAS runs on one thread
_FARTHEST = 1e4
"""Bound of the numbers in the tables: features are unit vectors."""
_SAMPLE = 20000  # rows to which the quantizers are fitted


@dataclass(frozen=True)
class Codec:
    """Encodes (V, D) unit features to (V, M) uint8, and decodes them.

    basis: (R, D) float32 orthonormal directions.  bits: (R,) uint8, 8s, then 4s, then 2s; the number of 4s is a
    multiple of two, that of 2s a multiple of four.  offset, scale: (R,) float32; coordinate = offset + scale * level.
    The row of values from the coordinates is normalized.
    """

    basis: NDArray[np.float32]
    bits: NDArray[np.uint8]
    offset: NDArray[np.float32]
    scale: NDArray[np.float32]

    @property
    def code_bytes(self) -> int:
        """M, the length of a code."""
        return int(self.bits.sum()) // 8

    @classmethod
    def fit(cls, features: NDArray[np.floating], most_bytes: int = MOST_BYTES) -> Codec:
        """Makes the codec with the least loss for (N, D) features; ignores rows of zeros."""
        dimension = features.shape[1]
        known = np.flatnonzero(features.any(axis=1))
        if dimension <= most_bytes or not len(known):
            basis = np.eye(dimension, dtype=np.float32)[:most_bytes]
            bits = np.full(len(basis), 8, np.uint8)
        else:
            basis, energy = _directions(features)
            bits = _fewest(energy, most_bytes)
            basis = np.ascontiguousarray(basis[: len(bits)])
        low, high = np.full(len(bits), np.inf, np.float32), np.full(len(bits), -np.inf, np.float32)
        for rows in _chunks(features[known]):
            coordinates = rows.astype(np.float32) @ basis.T
            low = np.minimum(low, coordinates.min(axis=0))
            high = np.maximum(high, coordinates.max(axis=0))
        if not len(known):
            low, high = np.zeros_like(low), np.ones_like(high)
        low = np.where(low >= 0, np.maximum(low - _MARGIN, 0.0), low - _MARGIN).astype(np.float32)
        high = np.where(high <= 0, np.minimum(high + _MARGIN, 0.0), high + _MARGIN).astype(np.float32)
        scale = np.maximum(high - low, np.float32(_TINY)) / np.float32(_LEVELS)
        offset = low - scale  # level 1 is the lowest
        sample = features[known[:: max(1, len(known) // _SAMPLE)]].astype(np.float32) @ basis.T
        for row in np.flatnonzero(bits < 8):
            offset[row], scale[row] = _coarse(sample[:, row], int(bits[row]))
        return cls(basis, bits, offset, scale)

    def encode(self, features: NDArray[np.floating]) -> NDArray[np.uint8]:
        """Encodes (V, D) features; coordinates outside their range are clipped to it."""
        codes = np.empty((len(features), self.code_bytes), np.uint8)
        lowest = np.where(self.bits == 8, 1, 0)
        highest = (1 << self.bits.astype(np.int64)) - 1
        for rows, out in zip(_chunks(features), _chunks(codes), strict=True):
            coordinates = rows.astype(np.float32) @ self.basis.T
            level = np.clip(np.rint((coordinates - self.offset) / self.scale), lowest, highest).astype(np.uint8)
            at = filled = 0
            for bits in _BITS:
                own = level[:, at : at + np.count_nonzero(self.bits == bits)]
                share = 8 // bits
                packed = np.zeros((len(own), own.shape[1] // share), np.uint8)
                for part in range(share):
                    packed |= own[:, part * packed.shape[1] : (part + 1) * packed.shape[1]] << np.uint8(bits * part)
                out[:, filled : filled + packed.shape[1]] = packed
                at, filled = at + own.shape[1], filled + packed.shape[1]
            out[~rows.any(axis=1)] = 0
        return codes

    def decode(self, codes: NDArray[np.uint8]) -> NDArray[np.float16]:
        """Decodes (V, M) codes to unit features; the zero feature comes back exactly."""
        features = np.empty((len(codes), self.basis.shape[1]), np.float16)
        for rows, out in zip(_chunks(codes), _chunks(features), strict=True):
            values = (self._levels(rows) * self.scale + self.offset) @ self.basis
            values[~rows.any(axis=1)] = 0
            norms = np.linalg.norm(values, axis=1, keepdims=True)
            out[:] = values / np.where(norms > 0, norms, 1)
        return features

    def inverse_norms(self, codes: NDArray[np.uint8]) -> NDArray[np.float32]:
        """(V,) 1 over the norms of the rows of coordinates that the codes mean; 0 for zero features."""
        inverse = np.zeros(len(codes), np.float32)
        for rows, out in zip(_chunks(codes), _chunks(inverse), strict=True):
            values = self._levels(rows)
            values *= self.scale
            values += self.offset
            squared = np.einsum("vr,vr->v", values, values)
            something = (rows[:, 0] > 0) & (squared > 0)  # the first level has 8 bits
            np.divide(1, np.sqrt(squared), out=out, where=something)
        return inverse

    def cosines(
        self, codes: NDArray[np.uint8], text: NDArray[np.floating], inverse: NDArray[np.float32] | None = None
    ) -> NDArray[np.float32]:
        """(V, W) cosines of coded features with (W, D) unit text features, without decoding. With levels c and text t
        in the codec's coordinates, the dot product is c (scale t) + offset t. Zero features give zero. inverse: the
        ``inverse_norms`` of the codes, if known. Raises MapError for another D."""
        if text.shape[1] != self.basis.shape[1]:
            raise MapError(
                f"The map is damaged: its features have {self.basis.shape[1]} dimensions, its encoder's words "
                f"{text.shape[1]}."
            )
        t = _product(text.astype(np.float32), self.basis.T)
        if _compiled(len(codes)):
            from . import coded_scores

            fours, twos = (int(np.count_nonzero(self.bits == bits)) * bits // 8 for bits in _BITS[1:])
            return np.asarray(coded_scores.compute_coded_cosines(codes, fours, twos, self.scale, self.offset, t))
        linear, constant = (t * self.scale).T, t @ self.offset
        inverse = self.inverse_norms(codes) if inverse is None else inverse
        scores = np.empty((len(text), len(codes)), np.float32).T  # the scores of a word are contiguous
        for rows, length, out in zip(_chunks(codes), _chunks(inverse), _chunks(scores), strict=True):
            np.multiply(_product(self._levels(rows), linear) + constant, length[:, None], out=out)
        return scores

    def _levels(self, codes: NDArray[np.uint8]) -> NDArray[np.float32]:
        """(V, R) levels of (V, M) codes."""
        parts: list[NDArray[np.uint8]] = []
        read = 0
        for bits in _BITS:
            share = 8 // bits
            own = codes[:, read : read + int(np.count_nonzero(self.bits == bits)) // share]
            mask = np.uint8((1 << bits) - 1)
            parts += [own] if share == 1 else [(own >> np.uint8(bits * part)) & mask for part in range(share)]
            read += own.shape[1]
        return np.concatenate(parts, axis=1).astype(np.float32)

    def tables(self) -> dict[str, NDArray[Any]]:
        """The tables that ``from_tables`` needs."""
        return {"basis": self.basis, "bits": self.bits, "offset": self.offset, "scale": self.scale}

    @classmethod
    def from_tables(cls, tables: Mapping[str, NDArray[Any]]) -> Codec:
        """Restores the codec that a map was saved with. Raises ValueError if the tables do not belong together."""
        basis, bits, offset, scale = (tables[name] for name in ("basis", "bits", "offset", "scale"))
        fit = basis.ndim == 2 and bits.shape == offset.shape == scale.shape == basis.shape[:1]
        counts = {b: int(np.count_nonzero(bits == b)) for b in _BITS}
        ordered = fit and np.array_equal(bits, np.repeat(_BITS, [counts[b] for b in _BITS]))
        if not ordered or any(count % (8 // b) for b, count in counts.items()):
            raise ValueError("the codec's tables do not belong together")
        with np.errstate(over="ignore"):
            basis, offset, scale = (table.astype(np.float32) for table in (basis, offset, scale))
        if not all((np.abs(table) <= _FARTHEST).all() for table in (basis, offset, scale)) or not (scale > 0).all():
            raise ValueError("the codec's tables hold numbers that no codec has")
        return cls(basis, bits.astype(np.uint8), offset, scale)


@dataclass(frozen=True)
class CodedFeatures:
    """(V, D) unit features that stay encoded as (V, M) ``codes``; ``np.asarray`` decodes them."""

    codec: Codec
    codes: NDArray[np.uint8]

    def __len__(self) -> int:
        return len(self.codes)

    def __getitem__(self, rows: Any) -> CodedFeatures:
        return CodedFeatures(self.codec, self.codes[rows])

    @functools.cached_property
    def inverse_norms(self) -> NDArray[np.float32]:
        """(V,) ``Codec.inverse_norms``, kept because many words are compared with the same features."""
        return self.codec.inverse_norms(self.codes)

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        return self.codec.decode(self.codes).astype(dtype or np.float16, copy=False)

    @property
    def shape(self) -> tuple[int, int]:
        """(V, D)."""
        return len(self.codes), self.codec.basis.shape[1]


Features: TypeAlias = NDArray[np.floating] | CodedFeatures


def compute_cosines(features: Features, text: NDArray[np.floating]) -> NDArray[np.float32]:
    """(V, W) cosines of unit features, coded or not, with (W, D) unit text features; zero features give zero."""
    if isinstance(features, CodedFeatures):
        inverse = None if _compiled(len(features)) else features.inverse_norms
        return features.codec.cosines(features.codes, text, inverse)
    found = np.empty((len(text), len(features)), np.float32).T
    t = text.astype(np.float32).T
    for rows, out in zip(_chunks(features), _chunks(found), strict=True):
        out[:] = _product(rows.astype(np.float32, copy=False), t)
    return found


def mask_known(features: Features) -> NDArray[np.bool_]:
    """(V,) whether each feature is known, that is, not zero."""
    rows = features.codes[:, :1] if isinstance(features, CodedFeatures) else features  # level 0: only a zero feature
    return np.asarray(rows.any(axis=1))


def average_known(features: Features) -> NDArray[np.float32]:
    """(D,) mean of the known features, or of an even sample of them; zeros if none is known."""
    rows = np.flatnonzero(mask_known(features))
    rows = rows[:: max(1, len(rows) // _SAMPLE)]
    if not len(rows):
        return np.zeros(features.shape[1], np.float32)
    return np.asarray(np.asarray(features[rows], np.float32).mean(axis=0))


def _compiled(count: int) -> bool:
    """Whether numba computes ``count`` scores. For fewer scores, importing numba takes longer than computing them."""
    return count >= MANY or f"{__package__}.coded_scores" in sys.modules


def _product(a: NDArray[np.float32], b: NDArray[np.float32]) -> NDArray[np.float32]:
    """(V, R) @ (R, W) in tiles that OpenBLAS does not split between threads. If other programs are running, as on a
    robot, waiting for these threads takes longer than such a small product: 10 to 20 ms each time."""
    tile = max(1, _ONE_THREAD // max(b.size, 1))
    count = len(a) // tile
    whole = count * tile
    out = np.empty((len(a), b.shape[1]), np.float32)
    np.matmul(a[:whole].reshape(count, tile, a.shape[1]), b, out=out[:whole].reshape(count, tile, b.shape[1]))
    np.matmul(a[whole:], b, out=out[whole:])
    return out


def _directions(features: NDArray[np.floating]) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
    """(D, D) orthonormal directions, and the mean square along each, largest first."""
    moments = np.zeros((features.shape[1],) * 2)
    for rows in _chunks(features):
        values = rows.astype(np.float32)
        moments += values.T @ values
    energy, columns = np.linalg.eigh(moments / len(features))
    return np.ascontiguousarray(columns[:, ::-1].T, np.float32), np.maximum(energy[::-1], 0.0)


def _fewest(energy: NDArray[np.float64], most_bytes: int) -> NDArray[np.uint8]:
    """``_shared_out`` for the smallest number of bytes that leaves hardly more energy than all bytes."""
    _, least = _shared_out(energy, most_bytes)
    for count in range(8, most_bytes, 8):
        bits, left = _shared_out(energy, count)
        if left <= max(_NO_WORSE * least, _HARDLY * energy.sum()):
            return bits
    return _shared_out(energy, most_bytes)[0]


def _shared_out(energy: NDArray[np.float64], most_bytes: int) -> tuple[NDArray[np.uint8], float]:
    """(R,) bits of the first R directions, and the remaining energy. Of all ways to spend the bytes on 8, 4 and 2 bits,
    this one leaves the least energy."""
    below = np.concatenate(([0.0], np.cumsum(energy)))
    eights, fours = np.meshgrid(np.arange(1, most_bytes + 1), np.arange(most_bytes), indexing="ij")
    twos = most_bytes - eights - fours
    eights, fours, twos = (count[twos >= 0] for count in (eights, fours, twos))
    ends = np.cumsum(np.stack((eights, 2 * fours, 4 * twos)), axis=0)
    fits = ends[2] <= len(energy)
    ends = ends[:, fits]
    left = below[-1] - below[ends[2]]
    for start, end, bits in zip((np.zeros_like(ends[0]), *ends[:2]), ends, _BITS, strict=True):
        left = left + _ERRORS[bits] * (below[end] - below[start])
    best = int(np.argmin(left))
    counts = np.diff(np.concatenate(([0], ends[:, best])))
    return np.repeat(np.array(_BITS, np.uint8), counts), float(left[best])


def _coarse(values: NDArray[np.float32], bits: int) -> tuple[float, float]:
    """Offset and step of the uniform quantizer with the least squared error, near Max's for a normal distribution."""
    mean, deviation = float(values.mean()), max(float(values.std()), _TINY)
    top = (1 << bits) - 1
    best, least = (0.0, 1.0), np.inf
    for step in _STEPS[bits] * deviation * _TRIED:
        offset = mean - 0.5 * top * step
        error = float(((np.clip(np.rint((values - offset) / step), 0, top) * step + offset - values) ** 2).mean())
        if error < least:
            best, least = (offset, step), error
    return best


def _chunks(rows: NDArray[Any]) -> Iterator[NDArray[Any]]:
    """Views of successive rows."""
    return (rows[start : start + _ROWS] for start in range(0, len(rows), _ROWS))
