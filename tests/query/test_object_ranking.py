"""Answers with whole objects: what matches most of an object finds it once, and what matches besides follows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from worded_voxels import SIZE, WORDS, box, feature, occupancy

from freeocc3d.core.types import Occupancy
from freeocc3d.language.feature_codec import Codec, CodedFeatures
from freeocc3d.query.objects.object import Object
from freeocc3d.query.objects.ranking import pool_features, rank_objects
from freeocc3d.query.oriented_boxes import oriented_boxes
from freeocc3d.query.regions import Region, best_regions
from freeocc3d.query.word_query import Options, QueryResult, query

CUP, SOFA, TABLE = feature(CUP=1), feature(SOFA=1), feature(COFFEE=1)


def thing(made: Occupancy, low: tuple[int, int, int], high: tuple[int, int, int], name: str = "cup") -> Object:
    """The object of all voxels in a box."""
    voxels = made.occupied_voxels()
    rows = np.flatnonzero(((voxels >= low) & (voxels < high)).all(axis=1))
    one = np.ones(len(rows), np.float32)
    (region,) = best_regions(made, rows, np.zeros(len(rows), np.int32), one, one, 1, 0.0, 1)
    (around,) = oriented_boxes(made, [region], np.eye(4))
    return Object(rows, feature(), ((name, 1.0),), around, region.volume_m3, region.centroid, (), 1.0)


def ask(made: Occupancy, word: str = "cup") -> QueryResult:
    return query(made, WORDS, [word], Options(top_k=10**6, narrow=0.0))[0]


def ranked(made: Occupancy, objects: list[Object], word: str = "cup") -> QueryResult:
    """The answer with whole objects; those without features only gather the votes of their voxels."""
    return rank_objects(made, ask(made, word), ask(pool_features(made, objects), word), objects)


def told(region: Region) -> tuple[int | None, str, int]:
    return region.number, region.name, region.voxels


def test_an_object_in_pieces_is_one_answer_with_all_its_voxels() -> None:
    striped = {
        cell: (CUP if cell[0] % 3 else TABLE) for cell in box((0, 0, 0), (9, 3, 3), CUP)
    }  # two of three layers match
    made = occupancy(striped | box((20, 0, 0), (24, 4, 4), CUP))
    plain = ask(made)
    assert len(plain.regions) == 4
    found = ranked(made, [thing(made, (0, 0, 0), (9, 3, 3)), thing(made, (20, 0, 0), (24, 4, 4))]).regions
    assert [told(region) for region in found] == [(2, "cup", 64), (1, "cup", 81)]
    whole = found[1]
    np.testing.assert_allclose((whole.box_min, whole.box_max), ((0, 0, 0), (9 * SIZE, 3 * SIZE, 3 * SIZE)))
    volume = 81 * SIZE**3
    assert whole.score == pytest.approx(np.mean(plain.scores[whole.rows]) * volume / (volume + 1e-3), rel=1e-3)
    assert whole.confidence == pytest.approx(plain.regions[0].confidence, abs=0.01)


def test_a_region_over_two_objects_and_the_floor_becomes_three_answers() -> None:
    floor = box((0, 0, 0), (20, 20, 1), CUP)
    made = occupancy(floor | box((2, 2, 1), (6, 6, 4), CUP) | box((10, 2, 1), (13, 5, 4), CUP))
    assert len(ask(made).regions) == 1
    objects = [thing(made, (2, 2, 1), (6, 6, 4), "bowl"), thing(made, (10, 2, 1), (13, 5, 4))]
    assert [told(region) for region in ranked(made, objects).regions] == [
        (1, "bowl", 48),
        (2, "cup", 27),
        (None, "", 400),
    ]


@pytest.mark.parametrize(("layers", "whole"), [(2, True), (1, False)])
def test_half_of_an_object_must_match(layers: int, whole: bool) -> None:
    made = occupancy(box((0, 0, 0), (4, 4, layers), CUP) | box((0, 0, layers), (4, 4, 4), SOFA))
    found = ranked(made, [thing(made, (0, 0, 0), (4, 4, 4))]).regions
    assert [told(region) for region in found] == [(1, "cup", 64) if whole else (None, "", 16 * layers)]


def test_fringes_and_specks_beside_objects_are_left_out() -> None:
    cup, fringe = box((0, 0, 0), (4, 4, 4), CUP), box((4, 0, 0), (5, 4, 4), CUP)
    speck, region = box((20, 0, 0), (21, 3, 2), CUP), box((30, 0, 0), (32, 2, 2), CUP)
    made = occupancy(cup | fringe | speck | region)
    found = ranked(made, [thing(made, (0, 0, 0), (4, 4, 4))]).regions
    assert [told(region) for region in found] == [(1, "cup", 64), (None, "", 8)]


def test_without_matching_objects_an_answer_stays() -> None:
    made = occupancy(box((0, 0, 0), (2, 2, 2), CUP) | box((9, 0, 0), (11, 2, 2), SOFA))
    plain = ask(made)
    for objects in ([thing(made, (9, 0, 0), (11, 2, 2), "sofa")], []):
        assert list(map(told, ranked(made, objects).regions)) == list(map(told, plain.regions)) == [(None, "", 8)]
    assert ranked(made, [], "unicorn").regions == []


@pytest.mark.parametrize("coded", [False, True])
def test_an_objects_feature_answers_where_its_voxels_are_too_uncertain(coded: bool) -> None:
    rng = np.random.default_rng(0)
    made = occupancy(box((0, 0, 0), (6, 6, 6), CUP) | box((20, 0, 0), (26, 6, 6), SOFA))
    true = np.asarray(made.features, np.float32)
    noisy = true + rng.normal(0, 0.7, true.shape)
    noisy = (noisy / np.linalg.norm(noisy, axis=1, keepdims=True)).astype(np.float16)
    codec = Codec.fit(noisy)
    made = made.replace(features=CodedFeatures(codec, codec.encode(noisy)) if coded else noisy)
    objects = [thing(made, (0, 0, 0), (6, 6, 6)), thing(made, (20, 0, 0), (26, 6, 6), "sofa")]
    means = [noisy[own.rows].astype(np.float32).mean(axis=0) for own in objects]
    objects = [replace(own, feature=mean / np.linalg.norm(mean)) for own, mean in zip(objects, means, strict=True)]
    plain = ask(made).regions
    assert len(plain) > 1  # a part of the cup, and specks of the sofa
    assert plain[0].voxels < 0.9 * 216
    assert [told(region) for region in ranked(made, objects).regions] == [(1, "cup", 216)]
