"""The memory that may be taken."""

from pathlib import Path

import pytest

from freeocc3d.core import memory


def test_some_memory_is_free() -> None:
    assert 1 << 26 < memory.available_memory() < 1 << 50


def test_a_container_takes_its_limit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory, "_CGROUPS", ((tmp_path / "max", tmp_path / "current"),))
    (tmp_path / "current").write_text("1000\n")
    (tmp_path / "max").write_text("max\n")
    assert memory.available_memory() > 1 << 26
    (tmp_path / "max").write_text("5000\n")
    assert memory.available_memory() == 4000
    (tmp_path / "memory.stat").write_text("anon 7\ninactive_file 300\n")
    assert memory.available_memory() == 4300
    (tmp_path / "max").write_text("10\n")
    assert memory.available_memory() == 300
