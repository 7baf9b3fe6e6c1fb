"""Asks by class: finds the voxels whose nearest name in the map's vocabulary is the class."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..core.errors import FreeOccError
from ..core.types import Occupancy
from ..language import word_matching
from ..language.encoders.base import TextEncoder
from ..settings.registry import nearest
from .word_query import Options, QueryResult, find_regions, nearest_word, similarity


def query_classes(
    occupancy: Occupancy,
    text_encoder: TextEncoder,
    vocabulary: Sequence[str],
    names: Sequence[str],
    options: Options | None = None,
    up: Sequence[float] | NDArray[np.float64] = (0.0, 0.0, 1.0),
) -> list[QueryResult]:
    """Returns the regions of classes. No voxel is left out for its score, and no region for its size.

    vocabulary: the map's names; a voxel has the class of the nearest name by plain cosine.  options: only ``top_k`` and
    ``narrow`` apply.  A region's confidence is the mean softmax probability of the name against the other names.
    Raises FreeOccError for a name that the vocabulary does not hold; the message gives the nearest name.
    """
    number = {name.lower(): k for k, name in reversed(list(enumerate(vocabulary)))}
    for name in names:
        if not vocabulary:
            raise FreeOccError("The map has no vocabulary of classes: ask for words instead.")
        if name.lower() not in number:
            raise FreeOccError(f"The map has no class '{name}'{nearest(name.lower(), number)}: --classes lists them.")
    text = text_encoder.encode_words(list(vocabulary))
    of_voxel = nearest_word(occupancy.features, text)
    options = (options or Options()).changed(min_voxels=1, min_share=0.0)
    results = []
    for name in names:
        k = number[name.lower()]
        rows = np.flatnonzero(of_voxel == k)
        every = similarity(occupancy.features[rows], text)
        others = np.delete(every, k, axis=1)
        confidence = word_matching.compare_with_all(
            word_matching.compare_competitors(every[:, k], others, text_encoder.temperature)[1]
        )
        scores = np.zeros(len(of_voxel), np.float32)
        scores[rows] = every[:, k]
        regions = find_regions(occupancy, rows, scores[rows], confidence, -1.0, options, up, name)
        note = "" if regions else f"'{vocabulary[k]}' is the best class of no voxel in this map."
        results.append(QueryResult(name, vocabulary[k], note, regions, scores))
    return results
