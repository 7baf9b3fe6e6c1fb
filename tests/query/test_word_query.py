"""Queries on tiny synthetic maps with features set by hand."""

from __future__ import annotations

import subprocess
import sys
from itertools import product
from typing import Any, ClassVar

import numpy as np
import pytest
from numpy.typing import NDArray
from worded_voxels import CLASSES, CUP, WORDS, box, feature, occupancy

from freeocc3d.core.errors import ConfigError, FreeOccError, MapError
from freeocc3d.language.encoders.base import TextEncoder, TextFeatures
from freeocc3d.language.encoders.labels import LabelWords
from freeocc3d.occupancy.connected_components import label_components
from freeocc3d.query import word_query as asking
from freeocc3d.query.word_query import Options, query, similarity


def components_by_flooding(voxels: NDArray[np.int32]) -> set[frozenset[int]]:
    """Voxels that touch, found one neighbor at a time."""
    row = {tuple(v): n for n, v in enumerate(voxels.tolist())}
    found, seen = set(), set()
    for start in row:
        stack, members = [start], set()
        while stack:
            voxel = stack.pop()
            if voxel in seen or voxel not in row:
                continue
            seen.add(voxel)
            members.add(row[voxel])
            stack += [tuple(np.add(voxel, step)) for step in product((-1, 0, 1), repeat=3)]
        if members:
            found.add(frozenset(members))
    return found


@pytest.mark.parametrize("seed", range(5))
def test_components_are_those_of_flooding(seed: int) -> None:
    rng = np.random.default_rng(seed)
    voxels = np.unique(rng.integers(-12, 12, (400, 3)), axis=0).astype(np.int32)
    rng.shuffle(voxels)
    component = label_components(voxels)
    assert {frozenset(np.flatnonzero(component == c)) for c in np.unique(component)} == components_by_flooding(voxels)


@pytest.mark.parametrize("seed", range(5))
def test_compiled_components_are_the_same(seed: int) -> None:
    from freeocc3d.occupancy import component_labels

    rng = np.random.default_rng(seed)
    voxels = np.unique(rng.integers(-12, 12, (2000, 3)) + (300_000, -5, 0), axis=0).astype(np.int32)
    if seed % 2:
        rng.shuffle(voxels)
    component = component_labels.label_lattice(voxels)
    assert component is not None
    found = {frozenset(np.flatnonzero(component == c)) for c in np.unique(component)}
    assert found == components_by_flooding(voxels)
    assert component[np.unique(component, return_index=True)[1]].tolist() == list(range(len(found)))
    apart = (voxels[:40] * 100).astype(np.int32)
    assert component_labels.label_lattice(apart) is None
    assert len(np.unique(label_components(apart))) == 40


def test_each_of_26_neighbors_connects_and_no_other_does() -> None:
    for step in product((-2, -1, 0, 1, 2), repeat=3):
        if any(step):
            touching = max(map(abs, step)) == 1
            component = label_components(np.array([(0, 0, 0), step], np.int32))
            assert (component[0] == component[1]) == touching, step


def test_components_far_from_the_origin() -> None:
    voxels = np.array([(-500_000, 400_000, -3), (-499_999, 399_999, -4), (500_000, 0, 0)], np.int32)
    component = label_components(voxels)
    assert component[0] == component[1] != component[2]


def test_region_has_faces_centroid_and_volume_in_meters() -> None:
    room = occupancy(box((-3, 8, 1), (-1, 12, 2), feature(SOFA=1)), origin=(10.0, 20.0, -5.0))
    (result,) = query(room, WORDS, ["couch"])
    (region,) = result.regions
    assert result.matched
    np.testing.assert_allclose(region.box_min, (9.7, 20.8, -4.9))
    np.testing.assert_allclose(region.box_max, (9.9, 21.2, -4.8))
    np.testing.assert_allclose(region.centroid, (9.8, 21.0, -4.85))
    assert region.voxels == 8
    assert region.volume_m3 == pytest.approx(0.008)
    assert region.score == pytest.approx(8 / 9, abs=1e-3)  # 8 liters that match, 1 of doubt
    assert region.confidence > 0.99
    np.testing.assert_allclose(result.scores, 1, atol=1e-3)


def test_things_apart_are_regions_of_their_own_largest_first() -> None:
    room = occupancy(
        box((0, 0, 0), (2, 2, 2), feature(CUP=1))
        | box((5, 0, 0), (9, 4, 4), feature(CUP=1))
        | box((9, 0, 0), (12, 4, 4), feature(WALL=1))
    )
    regions = query(room, WORDS, ["cup"])[0].regions
    assert [region.voxels for region in regions] == [64, 8]
    assert regions[0].score > regions[1].score
    rows = {tuple(v) for v in room.occupied_voxels()[regions[1].rows].tolist()}
    assert rows == set(box((0, 0, 0), (2, 2, 2), feature(CUP=1)))


def test_a_speck_does_not_outrank_a_large_object_that_is_less_similar() -> None:
    room = occupancy(
        box((0, 0, 0), (4, 4, 4), feature(CUP=0.8, SOFA=0.4)) | box((20, 0, 0), (20 + 1, 1, 2), feature(CUP=1))
    )
    result = query(room, WORDS, ["cup"], Options(min_share=0.0))[0]
    large, speck = result.regions
    assert (large.voxels, speck.voxels) == (64, 2)
    assert result.scores[speck.rows].mean() > result.scores[large.rows].mean()
    assert large.score > speck.score


def test_specks_are_left_out_unless_they_are_all_there_is() -> None:
    speck = {(20, 0, 0): feature(CUP=1)}
    both = occupancy(box((0, 0, 0), (2, 2, 2), feature(CUP=1)) | speck)
    assert [r.voxels for r in query(both, WORDS, ["cup"])[0].regions] == [8]
    assert [r.voxels for r in query(both, WORDS, ["cup"], Options(min_voxels=1))[0].regions] == [8, 1]
    assert [r.voxels for r in query(occupancy(speck), WORDS, ["cup"])[0].regions] == [1]


def test_a_voxel_that_is_rather_something_else_does_not_match() -> None:
    room = occupancy({(0, 0, 0): feature(CUP=0.6, WALL=0.8)})
    assert not query(room, WORDS, ["cup"])[0].matched
    assert query(room, WORDS, ["wall"])[0].matched


def test_a_wider_word_finds_what_it_includes_and_its_members_do_not_compete() -> None:
    room = occupancy(
        box((0, 0, 0), (2, 2, 2), feature(COFFEE=1))
        | box((5, 0, 0), (7, 2, 2), feature(COFFEE=1, DINING=1))
        | box((10, 0, 0), (12, 2, 2), feature(COFFEE=0.6, WALL=0.4))
        | box((15, 0, 0), (17, 2, 2), feature(COFFEE=0.4, WALL=0.6))
    )
    tables = query(room, WORDS, ["table"])[0]
    assert sorted(region.box_min[0] for region in tables.regions) == pytest.approx([0.0, 0.5, 1.0])
    assert tables.scores.max() <= 1


def test_threshold_option_replaces_the_encoders() -> None:
    room = occupancy(box((0, 0, 0), (2, 2, 2), feature(CUP=0.8, SOFA=0.6)))
    assert query(room, WORDS, ["cup"])[0].matched
    assert not query(room, WORDS, ["cup"], Options(threshold=0.9))[0].matched


def test_voxels_of_which_nothing_is_known_match_nothing() -> None:
    room = occupancy(box((0, 0, 0), (2, 2, 2), feature()))
    result = query(room, WORDS, ["cup"], Options(threshold=0.0))[0]
    assert not result.matched
    assert not result.scores.any()


def test_top_k_regions_are_the_best() -> None:
    cubes = [box((6 * n, 0, 0), (6 * n + 1 + n, 2, 2), feature(CUP=1)) for n in range(4)]
    room = occupancy({voxel: f for cube in cubes for voxel, f in cube.items()})
    assert [r.voxels for r in query(room, WORDS, ["cup"], Options(top_k=2))[0].regions] == [16, 12]


def test_notes_say_why_nothing_or_only_a_part_was_found() -> None:
    room = occupancy(box((0, 0, 0), (2, 2, 2), feature(SOFA=1)))
    unknown, absent, part, whole = query(room, WORDS, ["unicorn", "cup", "red couch", "the couches"])
    assert (unknown.matched, unknown.understood, unknown.regions) == (False, "", [])
    assert "not understood" in unknown.note
    assert "cup, sofa" in unknown.note
    assert not absent.matched
    assert absent.note.startswith("Nothing in this map looks like 'cup'")
    assert part.matched
    assert part.note == "Only 'couch' of 'red couch' was understood, as sofa."
    assert whole.matched
    assert whole.note == "'the couches' was understood as sofa."


def test_a_prompt_asks_for_its_thing_and_a_denial_is_refused() -> None:
    scan = occupancy(box((0, 0, 0), (2, 2, 2), feature(CUP=1)))
    plain, framed = query(scan, WORDS, ["cup", "A photo of a cup."])
    assert framed.word == "A photo of a cup."
    assert (framed.understood, framed.note) == ("cup", "")
    assert [region.rows.tolist() for region in framed.regions] == [region.rows.tolist() for region in plain.regions]
    assert len(framed.regions) == 1
    with pytest.raises(FreeOccError, match=r"'not a cup' says what is not meant .*--not WORD"):
        query(scan, WORDS, ["not a cup"])
    with pytest.raises(FreeOccError, match=r"'no cup' says what is not meant"):
        query(scan, WORDS, ["cup"], negative=["no cup"])


def test_an_empty_map_answers() -> None:
    empty = occupancy({})
    (result,) = query(empty, WORDS, ["cup"])
    assert not result.matched
    assert result.note == "The map has no occupied voxels."
    assert result.scores.shape == (0,)


@pytest.mark.parametrize("word", ["", "   ", "cup " * 2500])
def test_empty_and_endless_words_are_refused_in_a_sentence(word: str) -> None:
    room = occupancy(box((0, 0, 0), (2, 2, 2), feature(SOFA=1)))
    with pytest.raises(FreeOccError) as refused:
        query(room, WORDS, ["sofa", word])
    assert len(str(refused.value)) < 120


def test_features_of_another_encoder_are_refused() -> None:
    room = occupancy(box((0, 0, 0), (2, 2, 2), feature(SOFA=1)))
    with pytest.raises(MapError, match="5 dimensions"):
        query(room, LabelWords(["nothing", "cup"]), ["cup"])


@pytest.mark.parametrize(
    "bad",
    [
        {"top_k": 0},
        {"min_voxels": 0},
        {"threshold": 1.5},
        {"grow": 0.0},
        {"grow": 1.5},
        {"scores": "best"},
        {"min_share": 2.0},
        {"narrow": float("nan")},
        {"threshold": float("nan")},
        {"grow": float("nan")},
    ],
)
def test_options_out_of_range_are_refused(bad: dict) -> None:
    with pytest.raises(ConfigError):
        Options(**bad)


class CloseWords(TextEncoder):
    """An encoder as CLIP: all words are similar, and the temperature is low."""

    threshold, temperature, same_word = 0.2, 0.01, 0.95
    rows: ClassVar = {"cup": (1.0, 0.0, 2.0, 0, 0), "sofa": (0.0, 1.0, 2.0, 0, 0), "mug": (1.0, 0.05, 2.0, 0, 0)}

    def encode_words(self, words: list[str]) -> TextFeatures:
        features = np.array([self.rows[word] for word in words], np.float32).reshape(-1, 5)
        return TextFeatures(features / np.linalg.norm(features, axis=1, keepdims=True), tuple(words))

    def contrast_words(self) -> list[str]:
        return ["sofa", "mug"]


def test_contrast_decides_where_all_similarities_are_high() -> None:
    encoder = CloseWords()
    cup, sofa = encoder.encode_words(["cup", "sofa"]).features
    room = occupancy(box((0, 0, 0), (2, 2, 2), cup) | box((5, 0, 0), (7, 2, 2), sofa))
    (region,) = query(room, encoder, ["cup"])[0].regions
    assert region.box_min[0] == 0
    assert region.confidence > 0.99
    assert similarity(room.features, encoder.encode_words(["cup"])).min() > 0.7


def test_contrast_words_of_the_scene_compete_like_the_encoders_own() -> None:
    class NoContrasts(CloseWords):
        def contrast_words(self) -> list[str]:
            return []

    encoder = NoContrasts()
    cup, sofa = encoder.encode_words(["cup", "sofa"]).features
    room = occupancy(box((0, 0, 0), (2, 2, 2), cup) | box((5, 0, 0), (7, 2, 2), sofa))
    assert len(query(room, encoder, ["cup"])[0].regions) == 2
    assert len(query(room, encoder, ["cup"], contrast=["sofa"])[0].regions) == 1


@pytest.mark.parametrize("scores", ["softmax", "relevancy"])
def test_probabilities_separate_what_cosines_hardly_do(scores: str) -> None:
    """Every cosine is 0.8 to 1; "lamp" is nearest to nothing that is there."""

    class WithCanonical(CloseWords):
        rows: ClassVar = CloseWords.rows | {
            "lamp": (0.0, 0.0, 2.0, 1.0, 0),
            **dict.fromkeys(("object", "things", "stuff", "texture"), (0.3, 0.3, 2.0, 0.3, 0)),
        }

    encoder = WithCanonical()
    cup, sofa = encoder.encode_words(["cup", "sofa"]).features
    room = occupancy(box((0, 0, 0), (2, 2, 2), cup) | box((5, 0, 0), (7, 2, 2), sofa))
    asked, absent = query(room, encoder, ["cup", "lamp"], Options(scores=scores))
    assert [region.box_min[0] for region in asked.regions] == [0]
    assert not absent.matched
    assert absent.scores.max() < 0.5 < 0.95 < asked.scores.max()


def test_relevancy_without_phrases_that_fit_anything_is_against_the_contrast_words() -> None:
    room = occupancy(box((0, 0, 0), (2, 2, 2), feature(CUP=1)) | {(9, 0, 0): feature()})
    result = query(room, WORDS, ["cup"], Options(scores="relevancy"))[0]
    assert result.matched
    assert np.count_nonzero(result.scores) == 8


def test_a_region_goes_on_over_what_fits_nearly_as_well_and_begins_nowhere_else() -> None:
    faint = feature(CUP=0.45, **dict.fromkeys(("SOFA", "COFFEE", "DINING", "WALL"), 0.44))
    assert 0.4 < faint[CUP] < 0.5
    room = occupancy(
        box((0, 0, 0), (2, 2, 2), feature(CUP=1)) | box((2, 0, 0), (4, 2, 2), faint) | box((9, 0, 0), (11, 2, 2), faint)
    )
    assert [r.voxels for r in query(room, WORDS, ["cup"])[0].regions] == [16]
    assert [r.voxels for r in query(room, WORDS, ["cup"], Options(grow=1.0))[0].regions] == [8]


@pytest.mark.parametrize("word", ["沙发", "диван", "كرسي", "🛋", "???", "\u200b\u0301"])
def test_words_in_other_scripts_are_not_understood_in_a_sentence(word: str) -> None:
    (result,) = query(occupancy(box((0, 0, 0), (2, 2, 2), feature(SOFA=1))), WORDS, [word])
    assert not result.matched
    assert "not understood" in result.note


def test_a_misspelled_word_is_corrected_and_a_real_one_gets_suggestions() -> None:
    room = occupancy(box((0, 0, 0), (2, 2, 2), feature(SOFA=1)))
    sofa, canoe, short = query(room, WORDS, ["Soffa", "canoe", "coup"])
    assert sofa.matched
    assert sofa.note == "'Soffa' was understood as sofa."
    assert canoe.note.startswith("'canoe' is not understood: ")
    assert short.note.startswith("'coup' is not understood (did you mean 'cup'?): this map knows only")
    with pytest.raises(FreeOccError, match="did you mean 'cup'"):
        query(room, WORDS, ["table"], negative=["coup"])


def test_results_do_not_depend_on_the_size_of_the_work_chunks(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(0)
    room = occupancy({voxel: rng.random(5) for voxel in box((0, 0, 0), (9, 9, 9), feature())})
    whole = query(room, WORDS, ["table", "cup"])
    monkeypatch.setattr(asking, "_ROWS", 50)
    parts = query(room, WORDS, ["table", "cup"])
    for a, b in zip(whole, parts, strict=True):
        np.testing.assert_allclose(a.scores, b.scores, atol=1e-6)
        assert [r.voxels for r in a.regions] == [r.voxels for r in b.regions]


def test_importing_the_query_imports_nothing_heavy() -> None:
    code = (
        "import sys, freeocc3d.query.word_query; "
        "import freeocc3d.language.encoders.color, freeocc3d.language.encoders.labels; "
        "print([m for m in ('scipy', 'numba', 'torch', 'open3d', 'cv2', 'typer') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


class OpenWords(LabelWords):
    """As an encoder of open vocabulary: it contrasts with nothing of its own."""

    open_vocabulary = True

    def contrast_words(self) -> list[str]:
        return []


def test_what_a_model_named_in_the_scene_competes_where_any_word_has_a_meaning() -> None:
    room = occupancy(box((0, 0, 0), (2, 2, 2), feature(CUP=0.6, WALL=0.8)))
    words = OpenWords(CLASSES)
    assert query(room, words, ["cup"])[0].matched
    assert not query(room, words, ["cup"], None, ["wall"])[0].matched
    assert query(room, words, ["wall"], None, ["wall", "cup", "unicorn"])[0].matched
    assert query(room, words, ["cup"], None, ["mug", "sofa"])[0].matched  # the same word does not compete
    closed = LabelWords(CLASSES)
    for named in ((), ["wall"]):
        assert query(room, closed, ["wall"], None, named)[0].matched


def test_occupied_voxels_are_kept_and_cannot_be_changed() -> None:
    room = occupancy(box((0, 0, 0), (2, 2, 2), feature(CUP=1)))
    assert room.occupied_voxels() is room.occupied_voxels()
    with pytest.raises(ValueError, match="read-only"):
        room.occupied_voxels()[0] = 5
    assert len(room.replace(state=np.zeros_like(room.state)).occupied_voxels()) == 0


def test_what_is_tiny_compared_with_the_largest_region_is_a_speck_whatever_the_voxels() -> None:
    patch = box((20, 0, 0), (22, 2, 1), feature(CUP=1))
    room = occupancy(box((0, 0, 0), (17, 17, 17), feature(CUP=1)) | patch)
    assert [r.voxels for r in query(room, WORDS, ["cup"])[0].regions] == [17**3]
    assert [r.voxels for r in query(room, WORDS, ["cup"], Options(min_share=0.0))[0].regions] == [17**3, 4]
    small = occupancy(box((0, 0, 0), (10, 10, 10), feature(CUP=1)) | patch)
    assert [r.voxels for r in query(small, WORDS, ["cup"])[0].regions] == [1000, 4]


def test_a_few_voxels_are_a_speck_next_to_a_thing_and_neither_far_from_it_nor_next_to_their_like() -> None:
    def found(first: int, thing: dict, **options: Any) -> list[int]:
        """Voxels of the regions where three in a row begin at voxel ``first`` along x."""
        few = box((first, 0, 0), (first + 3, 1, 1), feature(CUP=1))
        regions = query(occupancy(thing | few), WORDS, ["cup"], Options(**options))[0].regions
        return sorted(region.voxels for region in regions)

    thing = box((0, 0, 0), (4, 4, 4), feature(CUP=1))
    assert found(9, thing) == [64]  # half a meter
    assert found(10, thing) == [3, 64]
    assert found(9, thing, min_share=0.0) == [3, 64]
    assert found(8, box((0, 0, 0), (5, 1, 1), feature(CUP=0.8, SOFA=0.6))) == [3, 5]
