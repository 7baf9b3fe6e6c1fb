"""Compiled kernels go where they may: what is tried, in which order, and what is refused."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

import pytest

from freeocc3d.core import kernel_folders
from freeocc3d.core.kernel_folders import find_writable_folder


@pytest.fixture
def places(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An installation and all places for kernels in one folder. ``shut`` makes a place useless, for root as well."""
    for name in ("home", "temporary", "package"):
        (tmp_path / name).mkdir()
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setattr(tempfile, "gettempdir", lambda: str(tmp_path / "temporary"))
    find_writable_folder.cache_clear()
    yield tmp_path
    find_writable_folder.cache_clear()


def shut(place: Path) -> None:
    place.write_text("a file where a folder should be")


def found(places: Path) -> str | None:
    folder = find_writable_folder(places / "package")
    return None if folder is None else str(folder.relative_to(places).parent)


def test_each_place_is_tried_after_the_one_before(places: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(places / "named"))
    monkeypatch.setenv("XDG_CACHE_HOME", str(places / "caches"))
    expected = ["named", "package", "caches/freeocc3d", "home/.cache/freeocc3d", f"temporary/freeocc3d-{os.getuid()}"]
    for place in expected:
        assert found(places) == place
        find_writable_folder.cache_clear()
        path = places / place
        if place == "package":
            path = path / "__pycache__"
        for file in sorted(path.rglob("*"), reverse=True):
            file.rmdir()
        path.rmdir()
        shut(path)
    assert found(places) is None


@pytest.mark.parametrize("kind", ["link", "open to all", "of another user"])
def test_a_folder_that_others_may_write_is_refused(places: Path, monkeypatch: pytest.MonkeyPatch, kind: str) -> None:
    shut(places / "package" / "__pycache__")
    shut(places / "home" / ".cache")
    private = places / "temporary" / f"freeocc3d-{os.getuid()}"
    if kind == "link":
        (places / "elsewhere").mkdir()
        private.symlink_to(places / "elsewhere")
    else:
        private.mkdir(mode=0o700)
        assert kernel_folders._is_private(private)
        if kind == "open to all":
            private.chmod(0o777)
        else:
            other = os.getuid() + 1
            monkeypatch.setattr(os, "getuid", lambda: other)
            private.rename(private.with_name(f"freeocc3d-{os.getuid()}"))
    assert found(places) is None


def test_no_folder_for_temporary_files_is_no_error(places: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail() -> str:
        raise FileNotFoundError("No usable temporary directory found")

    shut(places / "package" / "__pycache__")
    monkeypatch.delenv("HOME")
    monkeypatch.setattr(tempfile, "gettempdir", fail)
    assert found(places) is None
