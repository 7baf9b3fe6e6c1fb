"""Words to voxels to regions: what ``freeocc3d query`` and ``Map.query`` do. Imports little, to start fast.

A voxel's score for a word is the paper's s(x, c) = f(x)^T t_c, the cosine of its feature and the word's. It matches
when the score reaches the encoder's threshold and no contrast word (what the voxel could be instead) scores higher
there: similarities alone do not tell "is" from "is a little like". Matching voxels that touch form a region.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from . import __version__
from .errors import FreeOccError
from .registry import require_positive
from .types import Occupancy

if TYPE_CHECKING:
    from .language.encoders.base import TextEncoder

_SAME_WORD = 0.8
_LONGEST_WORD = 200
_AXIS_BITS = 21


@dataclass(frozen=True)
class Options:
    """What counts as a match, and which regions are reported."""

    threshold: float | None = None
    """Least cosine similarity, 0…1; null = the encoder's own."""
    top_k: int = 20
    """At most so many regions a word."""
    min_voxels: int = 2
    """Smaller regions are left out, unless all are smaller."""

    def __post_init__(self) -> None:
        require_positive(self, "top_k", "min_voxels")


@dataclass(frozen=True)
class Region:
    """A connected set of matching voxels.

    score: mean cosine similarity of its voxels with the word.  confidence: 0…1, mean softmax probability of the word
    against the contrast words, at the encoder's temperature.  centroid: (3,) mean of the voxels' centres, map frame,
    metres.  box_min, box_max: (3,) corners of the axis-aligned box around the voxels, faces included, metres.
    rows: (n,) rows of ``Occupancy.occupied_voxels()``.
    """

    score: float
    confidence: float
    centroid: NDArray[np.float64]
    box_min: NDArray[np.float64]
    box_max: NDArray[np.float64]
    volume_m3: float
    rows: NDArray[np.int64]

    @property
    def voxels(self) -> int:
        """Number of voxels."""
        return len(self.rows)


@dataclass(frozen=True)
class QueryResult:
    """The answer to one word.

    understood: the part of the word that was used.  note: one sentence if nothing matched, or only a part of the word
    was understood; else empty.  regions: largest evidence (confidence times volume) first.  scores: (V,) cosine
    similarity of every occupied voxel.
    """

    word: str
    understood: str
    note: str
    regions: list[Region]
    scores: NDArray[np.float32]

    @property
    def matched(self) -> bool:
        """Whether anything matched."""
        return bool(self.regions)


def query(
    occupancy: Occupancy, text_encoder: TextEncoder, words: list[str], options: Options | None = None
) -> list[QueryResult]:
    """Ask for several words; one that nothing matches gives no regions. FreeOccError for an empty or endless word."""
    options = options or Options()
    for word in words:
        if not word.strip():
            raise FreeOccError("An empty word cannot be looked for: give at least one word.")
        if len(word) > _LONGEST_WORD:
            raise FreeOccError(f"'{word[:30]}…' has {len(word)} characters; a query may have up to {_LONGEST_WORD}.")
    text = text_encoder.encode_words(words)
    contrasts = text_encoder.encode_words(text_encoder.contrast_words()).features
    features = occupancy.features.astype(np.float32)
    contrast_scores = features @ contrasts.T
    voxels = occupancy.occupied_voxels()
    return [
        _answer(
            occupancy, voxels, features, contrast_scores, contrasts, text_encoder, word, feature, understood, options
        )
        for word, feature, understood in zip(words, text.features, text.understood, strict=True)
    ]


def _answer(
    occupancy: Occupancy,
    voxels: NDArray[np.int32],
    features: NDArray[np.float32],
    contrast_scores: NDArray[np.float32],
    contrasts: NDArray[np.float32],
    text_encoder: TextEncoder,
    word: str,
    feature: NDArray[np.float32],
    understood: str,
    options: Options,
) -> QueryResult:
    scores = features @ feature if len(features) else np.zeros(0, np.float32)
    if not understood:
        return QueryResult(word, "", _note(word, "", text_encoder, matched=False), [], scores)
    others = contrast_scores[:, contrasts @ feature < _SAME_WORD]
    best_other = others.max(axis=1, initial=-1.0)
    threshold = text_encoder.threshold if options.threshold is None else options.threshold
    rows = np.flatnonzero((scores >= threshold) & (scores >= best_other))
    logits = (others[rows] - scores[rows, None]) / text_encoder.temperature
    confidence = 1.0 / (1.0 + np.exp(logits).sum(axis=1))
    regions = [
        _region(occupancy, voxels, rows[members], scores, confidence[members])
        for members in _groups(connected(voxels[rows]))
    ]
    large = [region for region in regions if region.voxels >= options.min_voxels] or regions
    large.sort(key=lambda region: -region.confidence * region.voxels)
    note = _note(word, understood, text_encoder, matched=bool(large))
    return QueryResult(word, understood, note, large[: options.top_k], scores)


def _region(
    occupancy: Occupancy,
    voxels: NDArray[np.int32],
    rows: NDArray[np.int64],
    scores: NDArray[np.float32],
    confidence: NDArray[np.float32],
) -> Region:
    own = voxels[rows]
    size = occupancy.voxel_size
    return Region(
        score=float(scores[rows].mean()),
        confidence=float(confidence.mean()),
        centroid=occupancy.centers(own).mean(axis=0),
        box_min=occupancy.origin + own.min(axis=0) * size,
        box_max=occupancy.origin + (own.max(axis=0) + 1) * size,
        volume_m3=len(rows) * size**3,
        rows=rows,
    )


def connected(voxels: NDArray[np.int32]) -> NDArray[np.int32]:
    """(V,) component number of each of (V, 3) distinct voxels; voxels that share a face, edge or corner are connected.

    Each voxel looks for 13 of its 26 neighbours among the sorted keys; the dense box is never made.
    """
    n = len(voxels)
    if n == 0:
        return np.zeros(0, np.int32)
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    keys = _keys(voxels)
    order = np.argsort(keys)
    ascending = keys[order]
    steps = np.indices((3, 3, 3)).reshape(3, -1).T[14:] - 1
    edges = []
    for step in (steps[:, 0] << 2 * _AXIS_BITS) + (steps[:, 1] << _AXIS_BITS) + steps[:, 2]:
        at = np.minimum(np.searchsorted(ascending, ascending + step), n - 1)
        here = np.flatnonzero(ascending[at] == ascending + step)
        edges.append(np.stack((order[here], order[at[here]])))
    pairs = np.concatenate(edges, axis=1)
    graph = coo_array((np.ones(pairs.shape[1], bool), pairs), shape=(n, n))
    return np.asarray(connected_components(graph, directed=False)[1])


def _keys(voxels: NDArray[np.int32]) -> NDArray[np.int64]:
    index = voxels.astype(np.int64) + (1 << _AXIS_BITS - 1)
    return (index[:, 0] << 2 * _AXIS_BITS) + (index[:, 1] << _AXIS_BITS) + index[:, 2]


def _groups(component: NDArray[np.int32]) -> list[NDArray[np.int64]]:
    """Members of each component."""
    order = np.argsort(component, kind="stable")
    return np.split(order, np.flatnonzero(np.diff(component[order])) + 1) if len(order) else []


def _note(word: str, understood: str, text_encoder: TextEncoder, matched: bool) -> str:
    if not understood:
        known = ", ".join(text_encoder.contrast_words()[:12])
        return f"Nothing is known of '{word}': this map's encoder knows words such as {known}."
    if not matched:
        return f"Nothing in this map looks like '{understood}'."
    if len(understood.split()) < len(word.split()):
        return f"Only '{understood}' of '{word}' could be used."
    return ""


def to_json(map_path: Path, results: list[QueryResult]) -> dict[str, Any]:
    """The document that ``query --json`` prints; metres, map frame, fractions 0…1."""
    return {
        "version": __version__,
        "map": str(map_path),
        "results": [
            {
                "word": result.word,
                "matched": result.matched,
                "understood": result.understood,
                "note": result.note,
                "regions": [
                    {
                        "score": round(region.score, 4),
                        "confidence": round(region.confidence, 4),
                        "centroid": region.centroid.round(4).tolist(),
                        "box_min": region.box_min.round(4).tolist(),
                        "box_max": region.box_max.round(4).tolist(),
                        "volume_m3": round(region.volume_m3, 6),
                        "voxels": region.voxels,
                    }
                    for region in result.regions
                ],
            }
            for result in results
        ],
    }


def to_text(results: list[QueryResult]) -> str:
    """A table for people."""
    lines = []
    for result in results:
        count = len(result.regions)
        title = f"{result.word}: {count} region{'s' if count != 1 else ''}" if count else f"{result.word}: no match"
        lines.append(f"{title}. {result.note}".rstrip(". ") + ("." if result.note else ""))
        if count:
            lines.append("   #  score  conf.  centroid (m)             size (m)            volume (l)  voxels")
        for number, region in enumerate(result.regions, start=1):
            x, y, z = region.centroid
            dx, dy, dz = region.box_max - region.box_min
            lines.append(
                f"  {number:2d}   {region.score:.2f}   {region.confidence:.2f}  "
                f"{x:7.2f} {y:7.2f} {z:7.2f}  {dx:5.2f} x {dy:4.2f} x {dz:4.2f}  {1000 * region.volume_m3:10.1f}  "
                f"{region.voxels:6d}"
            )
    return "\n".join(lines)
