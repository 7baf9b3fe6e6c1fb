"""What random words reach decides whether a word is in a map, whatever a model's cosines are."""

from __future__ import annotations

import copy
import functools
from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import pytest
from helpers import worded_voxels
from numpy.typing import NDArray

from freeocc3d.core.types import Occupancy
from freeocc3d.language.encoders.base import TextEncoder, TextFeatures
from freeocc3d.language.feature_codec import Codec, CodedFeatures
from freeocc3d.language.random_words import RANDOM_WORDS
from freeocc3d.query.chance import Chance
from freeocc3d.query.objects.finding import name_objects
from freeocc3d.query.word_query import Options, query
from freeocc3d.storage.manifest import ChanceRecord

SIZE = 256
CONTRAST = ["wall", "floor", "table"]
PRESENT = ["wall", "floor", "sofa", "table"]
ABSENT = ["zebra", "anchor", "violin", "cactus", "rocket", "tent", "saddle", "harp", "anvil", "cannon"]


class Model(TextEncoder):
    """Words around a mean of length 0.86, as CLIP's; "couch" is near "sofa"."""

    threshold = None
    temperature = 0.01
    open_vocabulary = True

    def __init__(self) -> None:
        self.words: dict[str, NDArray[Any]] = {}
        self.words["couch"] = self.embed("sofa") + 0.1 * _draw("couch")

    def embed(self, word: str) -> NDArray[Any]:
        return self.words.setdefault(word, 0.86 * np.eye(SIZE)[0] + 0.51 * _draw(word))

    def encode_words(self, words: list[str]) -> TextFeatures:
        rows = np.array([_unit(self.embed(word)) for word in words], np.float32).reshape(len(words), SIZE)
        return TextFeatures(rows, tuple(words))

    def contrast_words(self) -> list[str]:
        return CONTRAST


def _draw(word: str) -> NDArray[Any]:
    """A random unit vector, always the same for a word, orthogonal to what all words share."""
    drawn = np.random.default_rng([ord(letter) for letter in word]).standard_normal(SIZE)
    drawn[0] = 0
    return _unit(drawn)


def _unit(values: NDArray[Any]) -> NDArray[Any]:
    return values / np.linalg.norm(values)


def _voxels(corners: NDArray[np.int64], features: NDArray[np.float16]) -> Occupancy:
    made = worded_voxels.occupancy(dict.fromkeys(map(tuple, corners.tolist()), np.zeros(5)))
    of = {tuple(corner): row for row, corner in enumerate(corners.tolist())}
    order = [of[tuple(voxel)] for voxel in made.occupied_voxels().tolist()]
    return made.replace(features=features[order], colors=np.zeros((len(order), 3), np.uint8))


def _room(model: Model, offset: float, coded: bool) -> tuple[Occupancy, NDArray[np.int64]]:
    """Four slabs of 10 x 10 x 2 voxels whose features have cosines of about 0.26 + offset with their names, and 0.18 +
    offset with other words; and the slab of each voxel in the map."""
    rng = np.random.default_rng(2)
    voxels = np.argwhere(np.ones((10, 10, 2), bool))
    corners = np.concatenate([voxels + (0, 0, 8 * n) for n in range(len(PRESENT))])
    slab = np.repeat(np.arange(len(PRESENT)), len(voxels))
    gap = rng.standard_normal(SIZE) * (np.arange(SIZE) > 0)
    shared = (0.21 + offset / 0.86) * np.eye(SIZE)[0] + 0.7 * _unit(gap)
    own = np.stack([0.16 * _unit(model.embed(name) * (np.arange(SIZE) > 0)) for name in PRESENT])
    features = shared + own[slab] + 0.5 / np.sqrt(SIZE) * rng.standard_normal((len(corners), SIZE))
    features = (features / np.linalg.norm(features, axis=1, keepdims=True)).astype(np.float16)
    occupancy = _voxels(corners, features)
    if coded:
        codec = Codec.fit(features)
        occupancy = occupancy.replace(features=CodedFeatures(codec, codec.encode(occupancy.features)))
    return occupancy, occupancy.occupied_voxels()[:, 2] // 8


@functools.cache
def _asked(offset: float) -> tuple[Model, Occupancy, NDArray[np.int64], ChanceRecord]:
    """A room with what random words reach in it, measured once."""
    model = Model()
    room, slab = _room(model, offset, coded=True)
    return model, room, slab, Chance(room, model).record


@pytest.mark.parametrize("offset", [-0.15, 0.3])
def test_present_words_are_found_and_absent_ones_are_not_whatever_the_cosines(offset: float) -> None:
    model, room, slab, record = _asked(offset)
    for result, n in zip(query(room, model, PRESENT, chance=lambda: record), range(len(PRESENT)), strict=True):
        (region,) = result.regions
        assert region.score > 0.5, result.word
        assert region.voxels >= 160, result.word
        assert set(slab[region.rows]) == {n}
    answers = query(room, model, ABSENT, chance=lambda: record)
    assert sum(result.matched for result in answers) <= 1
    assert not set(PRESENT).difference(record.names)
    missing = next(result for result in answers if not result.matched)
    assert missing.note.startswith(f"Nothing in this map looks like '{missing.word}': the best score is 0.")


def test_a_synonym_is_found_beside_the_word_itself() -> None:
    model, room, slab, record = _asked(0.3)
    (result,) = query(room, model, ["couch"], contrast=["sofa"], chance=lambda: record)
    assert result.matched
    assert set(slab[result.regions[0].rows]) == {PRESENT.index("sofa")}
    (phrase,) = query(room, model, ["a photo of a couch."], contrast=["sofa"], chance=lambda: record)
    assert (phrase.word, phrase.understood) == ("a photo of a couch.", "couch")
    assert phrase.regions[0].voxels == result.regions[0].voxels
    (excluded,) = query(room, model, ["couch"], negative=["sofa"], chance=lambda: record)
    rows = np.concatenate([np.zeros(0, int), *(region.rows for region in excluded.regions)])
    features = np.asarray(room.features, np.float32)
    couch, sofa = model.encode_words(["couch", "sofa"]).features @ (features - 0.5 * record.mean_feature).T
    assert (couch[rows] >= sofa[rows] - 1e-4).all()
    assert 0 < len(rows) < sum(region.voxels for region in result.regions)


def test_what_lies_on_both_sides_of_what_is_not_meant_is_two_things() -> None:
    model, room, _, record = _asked(0.3)
    sofa, couch = model.encode_words(["sofa", "couch"]).features
    middle = np.isin(room.occupied_voxels()[:, 0], (4, 5))
    features = np.asarray(room.features, np.float32) + 2 * np.where(middle, 1, -1)[:, None] * (couch - sofa)
    features /= np.linalg.norm(features, axis=1, keepdims=True)
    (result,) = query(
        room.replace(features=features.astype(np.float16)), model, ["sofa"], negative=["couch"], chance=lambda: record
    )
    assert [region.voxels > 70 for region in result.regions] == [True, True]


def test_a_part_of_a_map_is_compared_with_the_whole() -> None:
    """As a map of a box around a thing is: of its own features, the thing's are the mean."""
    model, room, slab, record = _asked(0.3)
    codes = np.where((slab == PRESENT.index("sofa"))[:, None], room.features.codes, 0).astype(np.uint8)
    part = room.replace(features=CodedFeatures(room.features.codec, codes))
    found = [
        sum(region.voxels for region in query(part, model, ["sofa"], chance=lambda own=own: own)[0].regions)
        for own in (record, msgspec.structs.replace(record, center=b""))
    ]
    assert found[0] >= 160 > found[1], found


@pytest.mark.parametrize("thing", PRESENT)
@pytest.mark.parametrize("noise", [0.0, 0.03])
def test_a_map_of_one_thing_alone_finds_it(thing: str, noise: float) -> None:
    """Though its mean is the thing's own."""
    model, rng = Model(), np.random.default_rng(4)
    corners = np.argwhere(np.ones((10, 10, 2), bool))
    gap = _unit(rng.standard_normal(SIZE) * (np.arange(SIZE) > 0))
    own = 0.21 * np.eye(SIZE)[0] + 0.7 * gap + 0.16 * _unit(model.embed(thing) * (np.arange(SIZE) > 0))
    drawn = _unit(own) + noise * rng.standard_normal((len(corners), SIZE)) / np.sqrt(SIZE)
    features = drawn / np.linalg.norm(drawn, axis=1, keepdims=True)
    room = _voxels(corners, features.astype(np.float16))
    record = Chance(room, model).record
    found = query(room, model, [thing, *ABSENT], chance=lambda: record)
    assert [result.word for result in found if result.matched] == [thing]
    assert sum(region.voxels for region in found[0].regions) > 0.9 * len(corners)


def test_a_threshold_that_is_given_counts_instead() -> None:
    model, room, *_ = _asked(0.3)
    assert not query(room, model, ["sofa"], Options(threshold=0.9))[0].matched


def test_evidence_is_the_sum_of_deviations_over_its_spread_among_random_words() -> None:
    """Against a plain computation of one region."""
    model = Model()
    room, _ = _room(model, 0.0, coded=False)
    chance = Chance(room, model)
    (found,) = chance.find_regions(model.encode_words(["sofa"]).features, model.encode_words(CONTRAST).features)
    largest = np.bincount(found.component).argmax()
    rows = found.rows[found.component == largest]
    random = model.encode_words(list(RANDOM_WORDS)).features.astype(float)
    features = np.asarray(room.features, float)
    pooled = (features[rows] - features.mean(axis=0)).sum(axis=0)
    word = model.encode_words(["sofa"]).features[0] - random.mean(axis=0)
    surface = len(rows) * room.voxel_size**2
    expected = pooled @ word / (random @ pooled).std() * np.sqrt(surface / (surface + 0.05))
    assert found.evidence[largest] == pytest.approx(expected, rel=1e-2)
    assert chance.score(np.array([chance.record.evidence])) == pytest.approx(0.5)


def test_objects_are_named_by_what_tells_them_from_the_rest_of_the_map() -> None:
    """Even where the model gives one of the words a high cosine with every image."""
    model, room, slab, _ = _asked(0.3)
    model = copy.deepcopy(model)
    features = np.asarray(room.features, np.float32)
    model.words["piano"] = model.embed("piano") + 0.3 * _unit(features.mean(axis=0))
    names = SimpleNamespace(text_encoder=model, scene_words=[*PRESENT, "piano"], mean_feature=features.mean(axis=0))
    means = np.stack([features[slab == n].mean(axis=0) for n in range(len(PRESENT))])
    assert [own[0][0] for own in name_objects(names, means, 3)] == PRESENT
    assert (means @ model.encode_words([*PRESENT, "piano"]).features.T).argmax(axis=1).tolist() == [4] * 4
    assert name_objects(names, np.zeros((1, SIZE), np.float32), 3) == [()]


def test_a_map_without_voxels_answers_in_a_sentence() -> None:
    model = Model()
    empty = _voxels(np.zeros((0, 3), int), np.zeros((0, SIZE), np.float16))
    (result,) = query(empty, model, ["sofa"])
    assert (result.regions, result.note) == ([], "The map has no occupied voxels.")
