"""Queries by class: a partition of the map by its class names."""

from __future__ import annotations

import numpy as np
import pytest
from worded_voxels import CLASSES, WORDS, box, feature, occupancy

from freeocc3d.core.errors import FreeOccError
from freeocc3d.query.class_query import query_classes
from freeocc3d.query.word_query import Options, query

NAMES = CLASSES[1:]
ROOM = occupancy(
    box((0, 0, 0), (4, 4, 4), feature(SOFA=0.6, WALL=0.5))
    | box((4, 0, 0), (5, 4, 4), feature(SOFA=0.5, WALL=0.6))
    | box((20, 0, 0), (21, 1, 1), feature(SOFA=1))
    | box((30, 0, 0), (34, 4, 1), feature(CUP=0.3, COFFEE=0.3, DINING=0.4))
    | box((40, 0, 0), (44, 4, 1), np.zeros(len(NAMES)))
)


def test_each_voxel_belongs_to_its_best_class_and_to_no_other() -> None:
    features = ROOM.features.astype(float)
    best = np.where(features.any(axis=1), features.argmax(axis=1), -1)
    results = query_classes(ROOM, WORDS, NAMES, NAMES, Options(top_k=1000))
    for k, result in enumerate(results):
        rows = np.concatenate([np.zeros(0, int), *(region.rows for region in result.regions)])
        assert sorted(rows) == np.flatnonzero(best == k).tolist(), result.word
        assert np.flatnonzero(result.scores).tolist() == sorted(rows)
    by_name = {result.word: result for result in results}
    assert [region.voxels for region in by_name["sofa"].regions] == [64, 1], "no speck is left out"
    assert by_name["dining table"].matched
    assert not query(ROOM, WORDS, ["dining table"], Options(threshold=0.9))[0].matched, "a word asks for more"
    assert by_name["coffee table"].note == "'coffee table' is the best class of no voxel in this map."


def test_confidence_is_softmax_over_the_vocabulary() -> None:
    (sofa,) = query_classes(ROOM, WORDS, NAMES, ["Sofa"])[0].regions[:1]
    f = ROOM.features[sofa.rows[0]].astype(float)
    odds = np.exp(f / WORDS.temperature)
    assert sofa.confidence == pytest.approx(odds[NAMES.index("sofa")] / odds.sum(), abs=1e-3)
    assert sofa.label == "Sofa"


def test_a_name_that_is_no_class_names_the_nearest() -> None:
    with pytest.raises(FreeOccError, match=r"no class 'soffa' \(did you mean 'sofa'\?\): --classes lists them"):
        query_classes(ROOM, WORDS, NAMES, ["soffa"])
    with pytest.raises(FreeOccError, match="no vocabulary"):
        query_classes(ROOM, WORDS, [], ["sofa"])
    (nothing,) = query_classes(occupancy({}), WORDS, NAMES, ["sofa"])
    assert not nothing.matched
