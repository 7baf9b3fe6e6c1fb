"""Words for things in rooms: normal forms, synonyms, wider words, and which class names a phrase means."""

from __future__ import annotations

import pytest

from freeocc3d.language.synonyms import (
    INCLUDES,
    SYNONYMS,
    find_narrower,
    find_synonyms,
    find_wider,
    match_names,
    normalize_phrase,
)

HOUSE = [
    "bed", "nightstand", "chair", "carpet", "coffee table", "dining table", "side table", "desk", "door", "door handle",
    "sliding door", "kitchen cabinet", "tv cabinet", "lamp", "chandelier", "sofa", "tableware", "trash can",
    "television", "refrigerator", "window", "wall",
]  # fmt: skip


def found(phrase: str, names: list[str] | None = None) -> set[str]:
    names = HOUSE if names is None else names
    return {names[row] for row in match_names(phrase, names)[0]}


@pytest.mark.parametrize(
    ("phrase", "expected"),
    [
        ("The Coffee-Tables", "coffee table"),
        ("bookshelves", "bookshelf"),
        ("boxes", "box"),
        ("couches", "couch"),
        ("TVs", "tv"),
        ("glasses", "glass"),
        ("cutleries", "cutlery"),
        ("vases", "vase"),
        ("a glass", "glass"),
        ("indoor_plant", "indoor plant"),
        ("!?", ""),
    ],
)
def test_normal(phrase: str, expected: str) -> None:
    assert normalize_phrase(phrase) == expected


def test_normal_forms_are_their_own() -> None:
    for word in {w for group in SYNONYMS for w in group} | set(INCLUDES):
        assert normalize_phrase(normalize_phrase(word)) == normalize_phrase(word)


def test_synonyms_are_symmetric() -> None:
    for group in SYNONYMS:
        for word in group:
            assert {normalize_phrase(member) for member in group} <= find_synonyms(word)
            for other in find_synonyms(word):
                assert normalize_phrase(word) in find_synonyms(other)


def test_no_word_stands_in_two_groups() -> None:
    words = [normalize_phrase(word).replace(" ", "") for group in SYNONYMS for word in group]
    assert len(words) == len(set(words))


def test_wider_words_know_their_narrower_ones_and_no_circle_is_closed() -> None:
    for wide, inner in INCLUDES.items():
        for word in inner:
            assert normalize_phrase(wide) in find_wider(word)
            assert normalize_phrase(word) in find_narrower(wide)
        assert normalize_phrase(wide) not in find_narrower(wide)


@pytest.mark.parametrize(
    ("phrase", "names"),
    [
        ("sofa", {"sofa"}),
        ("Couches", {"sofa"}),
        ("TV", {"television"}),
        ("bin", {"trash can"}),
        ("garbage can", {"trash can"}),
        ("fridge", {"refrigerator"}),
        ("rug", {"carpet"}),
        ("table", {"coffee table", "dining table", "side table"}),
        ("dining table", {"dining table"}),
        ("end table", {"side table"}),
        ("door", {"door", "sliding door"}),
        ("door handle", {"door handle"}),
        ("cabinet", {"kitchen cabinet", "tv cabinet"}),
        ("cupboards", {"kitchen cabinet", "tv cabinet"}),
        ("light", {"lamp", "chandelier"}),
        ("night stand", {"nightstand"}),
        ("seating", {"chair", "sofa"}),
        ("armchair", {"chair"}),
        ("mug", {"tableware"}),
        ("the chair by the window", {"chair"}),
        ("cup of coffee", {"tableware"}),
    ],
)
def test_phrases_find_the_classes_that_people_mean(phrase: str, names: set[str]) -> None:
    assert found(phrase) == names


@pytest.mark.parametrize("phrase", ["unicorn", "", "   ", "§$%", "handle bar", "wallpaper", "red", "on the"])
def test_other_phrases_find_nothing(phrase: str) -> None:
    assert match_names(phrase, HOUSE) == ([], "")


@pytest.mark.parametrize(
    ("phrase", "part"), [("the red chair", "chair"), ("large dining tables", "dining table"), ("couch", "couch")]
)
def test_the_part_that_was_understood(phrase: str, part: str) -> None:
    assert match_names(phrase, HOUSE)[1] == part


def test_a_class_of_the_very_name_comes_before_its_synonyms() -> None:
    assert found("couch", ["sofa", "couch"]) == {"couch"}
    assert found("chest of drawers", ["dresser", "chest"]) == {"dresser"}


def test_class_names_of_other_data_sets() -> None:
    assert found("nightstand", ["night stand", "otherfurniture"]) == {"night stand"}
    assert found("plant", ["indoor-plant", "wall-plug"]) == {"indoor-plant"}
    assert found("tv", ["tv-screen", "tv-stand"]) == {"tv-screen"}
    assert found("curtain", ["shower curtain", "curtain", "blinds"]) == {"shower curtain", "curtain"}


def test_a_phrase_of_thousands_of_words() -> None:
    assert match_names("very " * 5000 + "sofa", HOUSE) == ([], "")
