"""Normal forms and which names a phrase means."""

import pytest

from freeocc3d.language import vocabulary


@pytest.mark.parametrize(
    ("phrase", "normal"),
    [
        ("The Coffee-Tables", "coffee table"), ("shelves", "shelf"), ("boxes", "box"), ("berries", "berry"),
        ("glass", "glass"), ("benches", "bench"), ("a  BUS", "bus"), ("tvs", "tv"), ("mattress", "mattress"),
        ("椅子", "椅子"), ("", ""),
    ],
)  # fmt: skip
def test_normal_form(phrase, normal) -> None:
    assert vocabulary.normal(phrase) == normal


def test_synonyms_are_symmetric() -> None:
    for group in vocabulary.SYNONYMS:
        for word in group:
            for other in group:
                assert vocabulary.normal(other) in vocabulary.synonyms(word)


@pytest.mark.parametrize(
    ("phrase", "names", "matched"),
    [
        ("chair", ["chair", "armchair"], ["chair"]),
        ("lamp", ["chandelier", "window"], ["chandelier"]),
        ("furniture", ["sofa", "wall", "bed"], ["sofa", "bed"]),
        ("door", ["door handle", "sliding door", "door"], ["sliding door", "door"]),
        ("my big red dining table", ["dining table", "desk"], ["dining table"]),
        ("wall", ["wallpaper", "wall"], ["wall"]),
        ("cup", ["cupboard"], []),
    ],
)
def test_matching_names(phrase, names, matched) -> None:
    found, _ = vocabulary.matching_names(phrase, names)
    assert [names[k] for k in found] == matched
