"""Which classes a phrase means: by name and synonym, by kind, by purpose, and despite mistakes."""

from pathlib import Path

import pytest

from freeocc3d.language.class_names import match_names
from freeocc3d.language.purposes import find_purpose
from freeocc3d.language.typing_mistakes import correct_words

HOUSE = [
    "bed", "nightstand", "chair", "carpet", "coffee table", "dining table", "side table", "desk", "door", "door handle",
    "sliding door", "kitchen cabinet", "tv cabinet", "lamp", "chandelier", "sofa", "tableware", "trash can",
    "television", "refrigerator", "window", "wall",
]  # fmt: skip


def found(phrase: str, names: list[str] | None = None) -> set[str]:
    names = HOUSE if names is None else names
    return {names[row] for row in match_names(phrase, names)[0]}


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


@pytest.mark.parametrize(
    ("phrase", "names"),
    [
        ("cupboards in the kitchen", {"kitchen cabinet"}),
        ("sliding glass door", {"sliding door"}),
        ("table for dinner", {"dining table"}),
        ("lamp next to the dining table", {"lamp", "chandelier"}),
        ("television unit", {"tv cabinet"}),
        ("telly stand", {"tv cabinet"}),
        ("bathroom cabinet", set()),
        ("the cabinet in the garage", set()),
        ("the cabinet in the kitchen", {"kitchen cabinet"}),
        ("spice rack", {"spice box"}),
        ("wooden rack", {"shoe rack"}),
        ("towel rack", set()),
        ("clothes cupboard", {"wardrobe"}),
        ("air conditioning unit", {"air conditioner"}),
        ("sewing machine", set()),
        ("mattress", {"bed"}),
        ("stools", {"chair"}),
    ],
)
def test_the_rest_of_a_phrase_decides_among_names(phrase: str, names: set[str]) -> None:
    more = ["shoe rack", "spice box", "wardrobe", "air conditioner"]
    assert found(phrase, [*HOUSE, *more]) == names


def test_a_part_means_its_whole_and_not_the_reverse() -> None:
    assert found("stool", ["chair", "stool"]) == {"stool"}
    assert found("chair", ["chair", "stool"]) == {"chair"}


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


def read_phrases(name: str) -> list[tuple[str, list[str], list[str]]]:
    """Phrases with the names that they mean, the one that must be found first, and the classes to choose from."""
    asked, classes = [], list[str]()
    for line in (Path(__file__).parent / name).read_text().splitlines():
        if line.startswith("# classes = "):
            classes = line.split(" = ")[1].split(", ")
        elif not line.startswith("#"):
            phrase, names = line.split(" = ")
            asked.append((phrase, [] if names == "-" else names.split(", "), classes))
    return asked


@pytest.mark.parametrize(("name", "least"), [("paraphrases.txt", 150), ("fresh_phrases.txt", 150)])
def test_what_people_say_is_understood(name: str, least: int) -> None:
    asked = read_phrases(name)
    right = wrong = 0
    for phrase, expected, classes in asked:
        names = found(phrase, classes)
        fits = names <= set(expected) and (expected[0] in names if expected else True)
        right, wrong = right + fits, wrong + bool(names and not fits)
    assert len(asked) >= least
    assert right >= 0.95 * len(asked)
    assert wrong <= 0.03 * len(asked)


@pytest.mark.parametrize("modifier", ["wine", "lunch", "pill", "park", "towel", "sewing", "cable", "jewelry"])
@pytest.mark.parametrize("name", ["shoe rack", "spice box", "exercise bench", "cake stand", "phone holder"])
def test_a_holder_of_other_things_is_not_found(name: str, modifier: str) -> None:
    holder = name.split()[1]
    for phrase in (f"{modifier} {holder}", f"the {holder} for {modifier}", f"big {modifier} {holder}"):
        assert found(phrase, [name]) == set(), phrase
    for phrase in (
        holder,
        f"big {holder}",
        f"dark red {holder}",
        f"the {holder} in the hall",
        f"wooden {holder}",
        name,
    ):
        assert found(phrase, [name]) == {name}, phrase


@pytest.mark.parametrize(
    ("phrase", "corrected"),
    [
        ("Refridgerator", "refrigerator"),
        ("an ofice chair", "an office chair"),
        ("cable", "cable"),  # no table
        ("sofe", "sofa"),
        ("cht", "cht"),  # too short
        ("blørgh", "blørgh"),  # like nothing
    ],
)
def test_only_words_that_do_not_exist_are_corrected(phrase: str, corrected: str) -> None:
    assert correct_words(phrase, ("table", "chair")) == corrected


def test_a_purpose_is_read_only_of_a_phrase_that_asks_for_one() -> None:
    assert find_purpose("where can I sit") == find_purpose("something for sitting") != ()
    assert find_purpose("the sitting dog") == find_purpose("water bottle") == ()
