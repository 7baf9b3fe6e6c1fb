"""Files that are missing, empty or no images are told before a run."""

from __future__ import annotations

from pathlib import Path

import pytest
from posed_captures import write_nerfstudio
from small_captures import write_scannet

from freeocc3d.capture import Options, open_capture
from freeocc3d.capture.checks.file_heads import check_heads, find_problem
from freeocc3d.core.errors import CaptureError


def damage(path: Path, how: str) -> None:
    if how == "missing":
        path.unlink()
    elif how == "folder":
        path.unlink()
        path.mkdir()
    else:
        path.write_bytes({"empty": b"", "text": b"hello, I am a text"}[how])


REASONS = {"missing": "cannot be opened", "folder": "cannot be opened", "empty": "is empty", "text": "is not an image"}


@pytest.mark.parametrize("how", REASONS)
@pytest.mark.parametrize("name", ["color/3.png", "depth/3.png"])
def test_what_cannot_be_read_is_told_with_the_first(tmp_path: Path, name: str, how: str) -> None:
    write_scannet(tmp_path, 12)
    capture = open_capture(tmp_path)
    assert check_heads(capture, range(12)) is None
    damage(tmp_path / name, how)
    notice = check_heads(capture, range(12))
    assert notice is not None
    assert notice.code == "images-unreadable"
    assert f"1 of 12 frames of {tmp_path} have a file that cannot be read. The first: {tmp_path / name}" in notice.text
    assert REASONS[how] in notice.text
    assert check_heads(capture, range(3)) is None


def test_too_many_end_the_run_at_once(tmp_path: Path) -> None:
    write_scannet(tmp_path, 12)
    capture = open_capture(tmp_path)
    for index in range(5):
        damage(tmp_path / "color" / f"{index}.png", "empty")
    with pytest.raises(CaptureError, match=r"5 of 12 frames .* raise capture\.max_broken"):
        check_heads(capture, range(12))
    tolerant = open_capture(tmp_path, Options(max_broken=0.5))
    assert check_heads(tolerant, range(12)) is not None


def test_reconstructions_are_looked_at_too(tmp_path: Path) -> None:
    write_nerfstudio(tmp_path, 12, depth=False)
    capture = open_capture(tmp_path)
    damage(tmp_path / "images" / "frame_7.png", "empty")
    notice = check_heads(capture, range(12))
    assert notice is not None
    assert "frame_7.png is empty" in notice.text


def test_decoders_go_by_content_and_so_does_the_check(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(b"\xff\xd8\xff\xe0 a JPEG")
    assert find_problem(tmp_path / "a.png") == ""
    (tmp_path / "a.npy").write_bytes(b"\xff\xd8\xff\xe0")
    assert find_problem(tmp_path / "a.npy") == "is not an image"
    (tmp_path / "a.heic").write_bytes(b"anything")
    assert find_problem(tmp_path / "a.heic") == ""
