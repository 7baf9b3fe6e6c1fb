"""Text in pictures: every letter is written, in whatever script, or told by its code point."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import freeocc3d.viewer
from freeocc3d.viewer import lettering
from freeocc3d.viewer.lettering import LEGEND, measure_text, write_text


@pytest.fixture
def no_fonts(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """As on a computer that has only the font of Pillow."""
    monkeypatch.setattr(lettering, "_MAIN", "")
    monkeypatch.setattr(lettering, "_font_files", lambda: ("",))
    lettering._letter.cache_clear()
    yield
    lettering._letter.cache_clear()


def drawn(text: str, size: int = LEGEND) -> np.ndarray:
    picture = np.full((40, 900, 3), 250, np.uint8)
    write_text(picture, text, (10, 25), size)
    return picture


def written(text: str) -> str:
    return "".join(run for _, run in lettering._runs(text, LEGEND))


@pytest.mark.parametrize("text", ["café", "Küche", "mobília", "żółw", "şömine", "кровать", "τραπέζι", "طاولة", "שולחן"])
def test_letters_of_many_scripts_are_written_as_they_are(text: str) -> None:
    assert written(text) == text
    assert not np.array_equal(drawn(text), drawn("?" * len(text)))


@pytest.mark.parametrize("text", ["café", "椅子", "طاولة القهوة", "bed\x1b[2J", "a\u202eb", "\U0001f6cf", "", "\n"])
def test_ink_lies_where_it_is_measured(text: str) -> None:
    rows, columns = np.nonzero((drawn(text) != 250).any(axis=-1))
    assert (len(columns) > 0) == bool(text)
    if text:
        assert 8 <= columns.min() <= 13
        assert columns.max() <= 11 + measure_text(text, LEGEND)
        assert 25 - 1.5 * LEGEND <= rows.min() <= rows.max() <= 25 + 0.5 * LEGEND


@pytest.mark.usefixtures("no_fonts")
@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("café", "cafe"),
        ("Å", "A"),
        ("椅子", "\\u6905\\u5b50"),
        ("red 椅", "red \\u6905"),
        ("\U0001f6cf", "\\U0001f6cf"),
    ],
)
def test_what_no_font_has_is_told_in_ascii(text: str, told: str) -> None:
    assert written(text) == told
    assert np.array_equal(drawn(text), drawn(told))


def test_what_the_main_font_lacks_is_written_with_another_of_the_computer(
    no_fonts: None, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    other, broken = lettering._find_main(), tmp_path / "broken.ttf"
    broken.write_text("no font")
    monkeypatch.setattr(lettering, "_font_files", lambda: ("", str(broken), other))
    runs = [(font.getname()[0], run) for font, run in lettering._runs("bed кровать 椅", LEGEND)]
    assert runs == [("Aileron", "bed "), ("DejaVu Sans", "кровать"), ("Aileron", " \\u6905")]


def test_control_characters_are_told_as_escapes() -> None:
    assert written("bed\x1b[2J\nwall\u202e") == "bed\\x1b[2J\\nwall\\u202e"


def test_decomposed_accents_are_composed() -> None:
    assert np.array_equal(drawn("cafe\u0301"), drawn("café"))


@pytest.mark.parametrize("name", ["طاولة القهوة", "שולחן"])
def test_a_name_from_right_to_left_is_one_part_and_leaves_what_follows(name: str) -> None:
    assert [run for _, run in lettering._runs(f"{name}: 3 regions", LEGEND)] == [name, ": 3 regions"]


@pytest.mark.parametrize("at", [(-30, 25), (890, 25), (10, -5), (10, 60), (5000, 25), (-500, -500)])
def test_text_beyond_the_picture_is_cut_off(at: tuple[int, int]) -> None:
    picture = np.full((40, 900, 3), 250, np.uint8)
    write_text(picture, "beyond", at, LEGEND)
    assert picture.shape == (40, 900, 3)


def test_all_pictures_write_with_it() -> None:
    folder = Path(freeocc3d.viewer.__file__).parent
    assert not [path.name for path in folder.glob("*.py") if "putText" in path.read_text()]
