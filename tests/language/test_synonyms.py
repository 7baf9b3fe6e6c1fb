"""Words for things in rooms: normal forms, synonyms, wider words, and which class names a phrase means."""

from __future__ import annotations

import pytest

from freeocc3d.language.synonyms import (
    INCLUDES,
    SYNONYMS,
    find_narrower,
    find_synonyms,
    find_wider,
    normalize_phrase,
)


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
