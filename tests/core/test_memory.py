"""The memory that may be taken."""

from pathlib import Path

import pytest

from freeocc3d.core import memory


def test_some_memory_is_free() -> None:
    assert 1 << 26 < memory.available_memory() < 1 << 50


def write(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)


def test_a_container_takes_its_limit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write(tmp_path / "self", "0::/\n")
    monkeypatch.setattr(memory, "MEMBERSHIP", tmp_path / "self")
    monkeypatch.setattr(memory, "MOUNT", tmp_path / "fs")
    write(tmp_path / "fs" / "memory.current", "1000\n")
    write(tmp_path / "fs" / "memory.max", "max\n")
    assert memory.available_memory() > 1 << 26
    write(tmp_path / "fs" / "memory.max", "5000\n")
    assert memory.available_memory() == 4000
    write(tmp_path / "fs" / "memory.stat", "anon 7\ninactive_file 300\n")
    assert memory.available_memory() == 4300
    write(tmp_path / "fs" / "memory.max", "10\n")
    assert memory.available_memory() == 300


def test_every_group_from_the_process_to_the_root_limits_it(tmp_path: Path) -> None:
    write(tmp_path / "self", "1:cpu:/x\n0::/pod/box\n")
    for group, most, used in (("pod/box", "max", "10"), ("pod", "700", "200"), (".", "9000", "1000")):
        write(tmp_path / "fs" / group / "memory.max", most)
        write(tmp_path / "fs" / group / "memory.current", used)
    assert list(memory._left(tmp_path / "self", tmp_path / "fs")) == [500, 8000]


def test_groups_of_version_1_limit_it(tmp_path: Path) -> None:
    write(tmp_path / "self", "4:memory:/a\n3:cpu,cpuacct:/\n")
    write(tmp_path / "fs" / "memory" / "a" / "memory.limit_in_bytes", "600")
    write(tmp_path / "fs" / "memory" / "a" / "memory.usage_in_bytes", "100")
    assert list(memory._left(tmp_path / "self", tmp_path / "fs")) == [500]
