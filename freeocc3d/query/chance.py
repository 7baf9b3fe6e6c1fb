"""Decides whether a word is in a map by what random words reach there, without a fixed cosine.

Cosines of images and words depend on the model, the word and the scene: a word's cosine with any image is higher or
lower than another's by as much as its presence adds. So no cosine means "there". With a word's text feature t, the mean
m of random words' features r, and the mean c of the map's features:

 1. A voxel f is the word's if f^T t - b(t) >= f^T t' - b(t') for each contrast word t', with b(t) = c^T t / 2. The mean
    c holds what the model gives the word in any image, and what the scene shows of it. Nothing tells the two apart, so
    half of it counts as either. A contrast word that is nearer to the word than to m, (t - m)^T (t' - m) >
    |t - m| |t' - m| / 2, means the same or a part of it, and does not compete.
 2. Voxels of the word that touch are a region, with F = sum (f - c), weighted by surface. Its evidence is
    F^T (t - m) / std_r F^T (r - m): how far the word stands out among random words there, in their standard deviations.
    Small regions are shrunk toward 0, as if a few patches of an image without evidence were part of them.
 3. The word is there if a region's evidence is higher than that of almost all random words' best regions in this map:
    higher than their mean plus 1.96 standard deviations.

What training by a sigmoid adds to each scaled cosine (SigLIP's logit_bias) is the same for all words: it cancels in
every step.

Sources: the gap between images and words: V. W. Liang et al., Mind the Gap, NeurIPS 2022. Scores relative to those of
other queries: S. V. Bogolin et al., Cross Modal Retrieval with Querybank Normalisation, CVPR 2022.
"""

from __future__ import annotations

import contextlib
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..core.errors import ModelError
from ..core.types import Occupancy
from ..language.encoders.base import Encoder, TextEncoder
from ..language.feature_codec import Features, average_known, compute_cosines, mask_known
from ..language.random_words import RANDOM_WORDS, list_house_names
from ..language.word_matching import compute_confidences
from ..occupancy.connected_components import label_components
from ..settings import registry
from ..storage.manifest import ChanceRecord, EncoderRecord

_SAME = 0.5
"""Cosine of deviations from the mean word, from which a word is nearer to another than to the mean."""
_OF_SCENE = 0.5
"""Share of the map's mean feature that counts as the model's, not the scene's."""
_PATCH_M2 = 0.05
"""Surface of a few patches of an image network in a room: 16 of 448 pixels are 8 to 12 cm at 2 to 3 m."""
_ABOVE = 1.96
"""Standard deviations above the mean of the random words' best evidence: 1 of 40 normally distributed ones is higher. A
quantile of 200 words, of which some may be there, is less certain."""
_ALIKE = 0.01
"""Variance of the features, of unit length, below which a map shows one kind of thing: of two kinds it is 0.04 and
more. Such a map's mean is that thing, so nothing is known of the model's share, and none is taken off."""
_LEAST = 1e-3
_ROWS = 16_384  # voxels in one step, and words: arrays of voxels x words stay small
_WORDS = 16


@dataclass(frozen=True)
class WordRegions:
    """The regions of a word in n voxels.

    rows, component: (n,) rows of occupied voxels, and their regions.  confidence: (n,) softmax against the contrast
    words.  evidence: (R,) of each region.
    """

    rows: NDArray[np.int64]
    component: NDArray[np.int32]
    confidence: NDArray[np.float32]
    evidence: NDArray[np.float64]


class Chance:
    """What random words score in a map. Raises ModelError if the text network of ``text_encoder`` is not found."""

    def __init__(self, occupancy: Occupancy, text_encoder: TextEncoder, record: ChanceRecord | None = None):
        self.occupancy, self.text_encoder = occupancy, text_encoder
        random = text_encoder.encode_words(list(RANDOM_WORDS)).features
        self._random = random[random.any(axis=1)]
        self._mean = self._random.mean(axis=0)
        self._known = mask_known(occupancy.features)
        stated = record.mean_feature if record else None
        center = average_known(occupancy.features) if stated is None else stated
        self._center = center if 1 - float(center @ center) >= _ALIKE else np.zeros_like(center)
        self.record = record or self._measure()

    def score(self, evidence: NDArray[np.float64]) -> NDArray[np.float64]:
        """0…1, 0.5 for evidence that one of 40 random words reaches, near 1 for evidence that none does."""
        return np.asarray(1 / (1 + np.exp(np.clip((self.record.evidence - evidence) / self.record.spread, -50, 50))))

    def compare(self, features: Features, text: NDArray[np.float32]) -> NDArray[np.float32]:
        """Returns (V, W) f^T t - b(t), by which (V, D) voxels tell (W, D) words apart."""
        return compute_cosines(features, text) - self._bias(text)

    def _bias(self, text: NDArray[np.float32]) -> NDArray[np.float32]:
        return np.asarray(_OF_SCENE * (text @ self._center), np.float32)

    def find_regions(self, text: NDArray[np.float32], others: NDArray[np.float32]) -> list[WordRegions]:
        """Returns the regions of each of W words, (W, D), among C contrast words, (C, D)."""
        found: list[WordRegions] = []
        for start in range(0, len(text), _WORDS):
            found += self._find_some(text[start : start + _WORDS], others)
        return found

    def _find_some(self, text: NDArray[np.float32], others: NDArray[np.float32]) -> list[WordRegions]:
        features = self.occupancy.features
        deviations = text - self._mean
        competes = (_cosines(deviations, others - self._mean) < _SAME) & others.any(axis=1)
        cosine = compute_cosines(features, np.concatenate((text, self._mean[None])))
        fits = cosine[:, :-1] - cosine[:, -1:] - deviations @ self._center
        candidates = self._known[:, None] & (fits > 0) & text.any(axis=1)
        own = cosine[:, :-1] - self._bias(text)
        asked = np.flatnonzero(candidates.any(axis=1))
        confidence = np.zeros(candidates.shape, np.float32)
        for start in range(0, len(asked), _ROWS):
            rows = asked[start : start + _ROWS]
            against = self.compare(features[rows], others)
            confidence[rows] = compute_confidences(
                own[rows], against, candidates[rows], competes, self.text_encoder.temperature
            )
        return [self._pool(np.flatnonzero(confidence[:, w]), confidence[:, w], fits[:, w]) for w in range(len(text))]

    def _pool(self, rows: NDArray[np.int64], confidence: NDArray[np.float32], fits: NDArray[np.float32]) -> WordRegions:
        """Returns the regions of a word that has ``rows``. confidence, fits: (V,)."""
        occupancy = self.occupancy
        if not len(rows):
            return WordRegions(rows, np.zeros(0, np.int32), confidence[rows], np.zeros(0))
        edges = occupancy.occupied_edges()[rows]
        component = label_components(occupancy.occupied_voxels()[rows], edges)
        count = int(component.max()) + 1
        area = (edges * occupancy.finest) ** 2
        surface = np.bincount(component, area, count)
        order = np.argsort(component, kind="stable")
        random = np.zeros((count, len(self._random)))
        deviations = self._random - self._mean
        for start in range(0, len(order), _ROWS):
            part = order[start : start + _ROWS]
            own = component[part]
            first = np.flatnonzero(np.diff(own, prepend=-1))
            weighted = compute_cosines(occupancy.features[rows[part]], deviations) * area[part, None]
            random[own[first]] += np.add.reduceat(weighted, first, axis=0)
        random -= surface[:, None] * (deviations @ self._center)
        pooled = np.bincount(component, fits[rows] * area, count)
        spread = np.maximum(random.std(axis=1), 1e-12)
        return WordRegions(
            rows, component, confidence[rows], pooled / spread * np.sqrt(surface / (surface + _PATCH_M2))
        )

    def _measure(self) -> ChanceRecord:
        """Returns the evidence of chance, of the best regions of the random words, each asked alone; and which names of
        things of houses have more."""
        contrast = self.text_encoder.contrast_words()
        others = self.text_encoder.encode_words(contrast).features
        best = self._best_evidence(self._random, others)
        mean, spread = (float(best.mean()), float(best.std())) if len(best) else (0.0, 0.0)
        evidence = max(mean + _ABOVE * spread, _LEAST)
        candidates = list_house_names(contrast)
        there = self._best_evidence(self.text_encoder.encode_words(candidates).features, others) >= evidence
        names = [name for name, found in zip(candidates, there, strict=True) if found]
        center = self._center.astype("<f2").tobytes()
        return ChanceRecord(evidence=evidence, spread=max(spread, _LEAST), names=names, center=center)

    def _best_evidence(self, text: NDArray[np.float32], others: NDArray[np.float32]) -> NDArray[np.float64]:
        return np.array([found.evidence.max(initial=0.0) for found in self.find_regions(text, others)])


def record_encoder(encoder: Encoder, occupancy: Occupancy) -> EncoderRecord:
    """Returns what a map of these voxels states of its encoder. Without a threshold of its own, that includes what
    random words reach, unless there are no voxels or the text network is not installed."""
    state = encoder.text_state()
    text_encoder = registry.load("language.encoders", encoder.name).load_text(state)
    chance = None
    if text_encoder.threshold is None and len(occupancy.colors):
        with contextlib.suppress(ModelError):
            chance = Chance(occupancy, text_encoder).record
    return EncoderRecord(name=encoder.name, dimension=encoder.dimension, state=state, chance=chance)


def _cosines(a: NDArray[np.float32], b: NDArray[np.float32]) -> NDArray[np.float32]:
    """Returns the (A, B) cosines of rows."""
    lengths = np.linalg.norm(a, axis=1)[:, None] * np.linalg.norm(b, axis=1)
    return np.asarray(a @ b.T / np.maximum(lengths, 1e-12))
