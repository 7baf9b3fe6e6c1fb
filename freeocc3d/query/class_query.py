"""Asking by class: exactly the voxels of which a name of the map's vocabulary is the nearest one."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..core.errors import FreeOccError
from ..core.types import Occupancy
from ..language import word_matching
from ..language.encoders.base import TextEncoder
from ..settings.registry import nearest
from .word_query import Options, QueryResult, found_regions, nearest_word, similarity


def query_classes(
    occupancy: Occupancy,
    text_encoder: TextEncoder,
    vocabulary: Sequence[str],
    names: Sequence[str],
    options: Options | None = None,
    up: Sequence[float] | NDArray[np.float64] = (0.0, 0.0, 1.0),
) -> list[QueryResult]:
    """The voxels of classes, in whose regions nothing is left out for its score or size.

    vocabulary: names of which each voxel has the one that is nearest by plain cosine.  options: of these ``top_k`` and
    ``narrow`` count.  A region's confidence is the mean softmax probability of the name against the
    vocabulary's others.
    Raises FreeOccError for a name that the vocabulary does not hold, naming the nearest.
    """
    number = {name.lower(): k for k, name in reversed(list(enumerate(vocabulary)))}
    for name in names:
        if not vocabulary:
            raise FreeOccError("The map has no vocabulary of classes: ask for words.")
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
        regions = found_regions(occupancy, rows, scores[rows], confidence, -1.0, options, up, name)
        note = "" if regions else f"'{vocabulary[k]}' is the best class of no voxel in this map."
        results.append(QueryResult(name, vocabulary[k], note, regions, scores))
    return results
