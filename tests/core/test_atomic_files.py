"""Files are complete or absent."""

from pathlib import Path

import pytest

from freeocc3d.core.atomic_files import is_temporary, replace_file, replace_text


def test_a_text_takes_the_place_of_the_one_before(tmp_path: Path) -> None:
    for text in ("first", "second"):
        replace_text(tmp_path / "a.json", text)
        assert (tmp_path / "a.json").read_text() == text
    assert [path.name for path in tmp_path.iterdir()] == ["a.json"]


def test_a_write_that_fails_leaves_the_file_before(tmp_path: Path) -> None:
    replace_text(tmp_path / "a.json", "first")

    def fail(temporary: Path) -> None:
        assert temporary.suffix == ".json"
        assert is_temporary(temporary)
        temporary.write_text("sec")
        raise OSError("the disk is full")

    with pytest.raises(OSError, match="full"):
        replace_file(tmp_path / "a.json", fail)
    assert (tmp_path / "a.json").read_text() == "first"
    assert [path.name for path in tmp_path.iterdir()] == ["a.json"]
    assert not is_temporary(tmp_path / "a.json")
