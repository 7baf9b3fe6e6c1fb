"""Files are complete or absent."""

import errno
import os
from pathlib import Path

import pytest

from freeocc3d.core.atomic_files import is_temporary, replace_file, replace_text, sync


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


@pytest.mark.parametrize("number", [errno.EINVAL, errno.EBADF])
def test_a_file_system_that_cannot_sync_folders_is_used_without(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    def refuse(descriptor: int) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(os, "fsync", refuse)
    sync(tmp_path)
    (tmp_path / "a").touch()
    with pytest.raises(OSError, match=os.strerror(number)):
        sync(tmp_path / "a")
    number = errno.EIO
    with pytest.raises(OSError, match=os.strerror(errno.EIO)):
        sync(tmp_path)
