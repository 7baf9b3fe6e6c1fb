import os
import socket
from pathlib import Path

import pytest

from freeocc3d.core import regular_files
from freeocc3d.core.checksums import hash_bytes, hash_file
from freeocc3d.core.regular_files import (
    UnusableFile,
    check_content,
    check_regular,
    list_names,
    read_bytes,
    read_text,
    user_path,
)


def special(kind: str, folder: Path) -> Path:
    path = folder / kind
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "socket":
        with socket.socket(socket.AF_UNIX) as made:
            made.bind(str(path))
    elif kind == "device":
        path.symlink_to("/dev/zero")
    else:
        path.mkdir()
    return path


@pytest.mark.parametrize("kind", ["pipe", "socket", "device", "folder"])
def test_only_regular_files_are_read_and_nothing_blocks(kind: str, tmp_path: Path) -> None:
    path = special(kind, tmp_path)
    for read in (check_regular, read_text, hash_file, lambda path: read_bytes(path, 10)):
        with pytest.raises(UnusableFile, match=f"it is a {kind}, not a regular file"):
            read(path)


def test_loops_of_links_missing_files_and_impossible_names_are_os_errors(tmp_path: Path) -> None:
    loop = tmp_path / "loop"
    loop.symlink_to(loop)
    for path in (loop, tmp_path / "missing", tmp_path / "a\0b", tmp_path / ("x" * 300)):
        with pytest.raises(OSError, match=r"."):
            read_text(path)


def test_a_larger_file_is_refused_before_it_is_read(tmp_path: Path) -> None:
    path = tmp_path / "sparse"
    with path.open("wb") as stream:
        stream.truncate(1 << 40)
    with pytest.raises(UnusableFile, match="more than the 1 MB"):
        read_bytes(path, 1 << 20)


def test_text_may_have_a_byte_order_mark_and_checksums_tell_a_flipped_bit(tmp_path: Path) -> None:
    path = tmp_path / "text"
    path.write_bytes(b"\xef\xbb\xbfa\xc3\xa4")
    assert read_text(path) == "aä"
    assert hash_file(path) == hash_bytes(path.read_bytes())
    assert hash_file(path) != hash_bytes(b"\xef\xbb\xbfa\xc3\xa5")
    path.write_bytes(b"\xff\xff")
    with pytest.raises(ValueError, match="utf-8"):
        read_text(path)


def test_the_names_in_a_folder_are_sorted_and_their_number_bounded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in (b"b", b"a", b"\xff", b"line\nbreak"):
        (Path(os.fsdecode(os.path.join(os.fsencode(tmp_path), name)))).write_bytes(b"")
    assert list_names(tmp_path) == ["a", "b", "line\nbreak", "\udcff"]
    monkeypatch.setattr(regular_files, "MOST_ENTRIES", 3)
    with pytest.raises(UnusableFile) as caught:
        list_names(tmp_path)
    assert caught.value.strerror == "it holds more than 3 files"


def test_a_home_that_is_unknown_leaves_the_path(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", "/home/me")
    assert user_path("~/scan") == Path("/home/me/scan")
    assert user_path("~nobody_of_this_name/scan") == Path("~nobody_of_this_name/scan")


def test_files_that_state_no_size_are_empty(tmp_path: Path) -> None:
    """/proc/kmsg would block, and /proc/self/mem never end."""
    for name in ("/proc/self/maps", "/proc/kmsg"):
        (tmp_path / "link").unlink(missing_ok=True)
        (tmp_path / "link").symlink_to(name)
        assert read_bytes(tmp_path / "link", 1 << 20) == b""


def test_a_file_that_a_library_opens_states_its_size(tmp_path: Path) -> None:
    """Reading those of /proc may block."""
    (tmp_path / "empty").touch()
    (tmp_path / "log").symlink_to("/proc/kmsg")
    for name in ("empty", "log"):
        with pytest.raises(UnusableFile, match="it is empty"):
            check_content(tmp_path / name)
    (tmp_path / "empty").write_bytes(b"1")
    assert check_content(tmp_path / "empty").st_size == 1
    with pytest.raises(UnusableFile, match="it is a folder"):
        check_content(tmp_path)
