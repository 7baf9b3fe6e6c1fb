"""Colors of things in maps of classes: of the chairs, those that "blue chair" means. The module imports little, to
start fast.

An encoder of classes says nothing about colors, but each occupied voxel has one, and color names have a meaning without
a network (``language.encoders.color``).
"""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..core.types import Occupancy
from ..language.encoders import color
from ..language.encoders.base import TextFeatures
from ..language.feature_codec import compute_cosines
from ..language.purposes import find_purpose
from .regions import Region

_MOST = 0.5  # share of a thing's voxels: a blue chair may have gray legs
_PART = 0.1
"""Least share of a region for things that touch others: at silhouettes, voxels mix the colors of two things."""
_ANYTHING = {"a", "an", "the", "any", "some", "all", "every", "everything", "that", "is", "are", "color", "colour"} | {
    f"{word}{ending}" for word in ("thing", "object", "item", "something", "anything", "stuff") for ending in ("", "s")
}


def read_colors(phrase: str, name: str) -> str:
    """The colors that a phrase adds to the name of a thing in it: "dark blue" for "a dark blue chair" and "chair".
    Empty if it adds none, or if they are a part of the name."""
    named = {} if find_purpose(phrase) else color.parse_colors(name)  # a purpose is understood as a whole
    return ", ".join(shade for shade in color.parse_colors(phrase) if shade not in named)


def read_only_colors(phrase: str) -> str:
    """The colors of a phrase that asks for them whatever has them: "light blue", "something red". Else empty."""
    others = [token for token in re.findall(r"[^\W_]+", phrase.lower()) if token not in _ANYTHING]
    if not all(token in color.MODIFIERS or color.parse_colors(token) for token in others):
        return ""
    return ", ".join(color.parse_colors(phrase))


def choose_colored(
    occupancy: Occupancy, regions: Sequence[Region], colors: str
) -> tuple[list[Region], NDArray[np.int64], NDArray[np.float32]]:
    """The regions most of whose voxels have the colors; and the rows (n,) of such voxels in regions of which they are a
    part, with the regions' confidence (n,): two cups that touch are one region, and neither color is that of most of
    it."""
    things, rows, confidence = [], [np.zeros(0, np.int64)], [np.zeros(0, np.float32)]
    for region in regions:
        fits = fit_colors(occupancy.colors[region.rows], colors)
        if fits.mean() > _MOST:
            things.append(region)
        if fits.mean() >= _PART:
            rows.append(region.rows[fits])
            confidence.append(np.full(np.count_nonzero(fits), region.confidence, np.float32))
    return things, np.concatenate(rows), np.concatenate(confidence)


def fit_colors(rgb: NDArray[np.uint8], colors: str) -> NDArray[np.bool_]:
    """(n,) whether (n, 3) sRGB fit a color name, and no basic color of another meaning better."""
    words = color.ColorWords()
    text, others = words.encode_words([colors]), words.encode_words(words.contrast_words())
    features = color.encode_colors(rgb)
    score = _compare(features, text)[:, 0]
    competes = compute_cosines(text.features, others.features)[0] < words.same_word
    against = _compare(features, others)[:, competes].max(axis=1, initial=0)
    return np.asarray((score >= words.threshold) & (score >= against))


def _compare(features: NDArray[np.float32], text: TextFeatures) -> NDArray[np.float32]:
    """(n, W) cosines over attainable cosines."""
    cosine = compute_cosines(features, text.features)
    return cosine if text.attainable is None else cosine / text.attainable
