"""What phrases ask for, and phrases that say what is not meant."""

import pytest

from freeocc3d.core.errors import FreeOccError
from freeocc3d.language.phrases import read_phrase
from freeocc3d.language.text_networks import TEMPLATES


@pytest.mark.parametrize("template", TEMPLATES)
def test_the_prompts_of_a_text_network_ask_for_their_word(template) -> None:
    found = read_phrase(template.format("coffee table"))
    assert found.removeprefix("small ").removeprefix("large ").removesuffix(" in a room") == "coffee table"


@pytest.mark.parametrize(
    ("phrase", "asked"),
    [
        ("a photo of a sofa.", "sofa"),
        ("Photo of sofas", "sofas"),
        ("an image of the red sofa", "red sofa"),
        ("The Picture of a Sofa by the window", "Sofa by the window"),
        ("this is a photo of a chair", "chair"),
        ("a low resolution, black and white photo of the bed", "bed"),
        ("a close-up of a lamp", "lamp"),
        ("a photo of a picture", "picture"),
        ("a rendering of an oven", "oven"),
        ("there is a sofa in the scene.", "sofa"),
        ("a picture", "a picture"),
        ("photo of", "photo of"),
        ("photo of .", "photo of ."),
        ("picture frame", "picture frame"),
        ("photo off a wall", "photo off a wall"),
        ("sofa beside a picture of a horse", "sofa beside a picture of a horse"),
        ("a painting of a horse", "a painting of a horse"),
        ("knot", "knot"),
        ("notebook", "notebook"),
        ("button", "button"),
        ("nightstand", "nightstand"),
        ("non-slip mat", "non-slip mat"),
        ("t-shirt", "t-shirt"),
        ("sofa.", "sofa."),
    ],
)
def test_the_frame_of_a_prompt_is_left_out_and_nothing_else(phrase, asked) -> None:
    assert read_phrase(phrase) == asked


@pytest.mark.parametrize(
    ("phrase", "word"),
    [
        ("not red", "not"),
        ("No chair", "No"),
        ("sofa without pillows", "without"),
        ("everything but the sofa", "but"),
        ("all except chairs", "except"),
        ("anything other than a table", "other than"),
        ("a photo of a sofa that is not red", "not"),
        ("a sofa that isn't red", "isn't"),
        ("chairs, excluding stools", "excluding"),
        ("the missing chair", "missing"),
        ("neither table nor chair", "neither"),
        ("opposite of red", "opposite of"),
        ("sugar-free shelf", "sugar-free"),
    ],
)
def test_a_phrase_that_says_what_is_not_meant_is_refused_with_the_way_to_say_it(phrase, word) -> None:
    with pytest.raises(FreeOccError, match=r"says what is not meant .*--not WORD\.$") as told:
        read_phrase(phrase)
    assert f"('{word}')" in str(told.value)


def test_names_of_things_stay_as_they_are() -> None:
    names = ["no parking sign", "picture of a horse"]
    assert [read_phrase(name.capitalize(), names) for name in names] == ["No parking sign", "Picture of a horse"]
