"""The number of threads follows what the system allows."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from freeocc3d.core import threads


def test_there_are_as_many_threads_as_processors_of_the_affinity(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: {0, 3, 5})
    monkeypatch.setattr(threads, "_quotas", lambda membership, mount: iter(()))
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    assert threads.count_threads() == 3


@pytest.mark.parametrize(("quotas", "expected"), [((8.0,), 4), ((2.5, 8.0), 3), ((0.3,), 1)])
def test_a_quota_limits_them(monkeypatch: pytest.MonkeyPatch, quotas: tuple[float, ...], expected: int) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: {0, 1, 2, 3})
    monkeypatch.setattr(threads, "_quotas", lambda membership, mount: iter(quotas))
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    assert threads.count_threads() == expected


def write(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)


def test_quotas_of_version_2_are_read_up_to_the_root(tmp_path: Path) -> None:
    write(tmp_path / "self", "0::/pod/box\n")
    write(tmp_path / "fs" / "pod" / "box" / "cpu.max", "max 100000\n")
    write(tmp_path / "fs" / "pod" / "cpu.max", "150000 100000\n")
    assert list(threads._quotas(tmp_path / "self", tmp_path / "fs")) == [1.5]


def test_quotas_of_version_1_are_read(tmp_path: Path) -> None:
    write(tmp_path / "self", "4:memory:/a\n3:cpuset:/\n2:cpu,cpuacct:/a\n")
    for group, quota in (("a", 200000), (".", -1)):
        write(tmp_path / "fs" / "cpu,cpuacct" / group / "cpu.cfs_quota_us", f"{quota}\n")
        write(tmp_path / "fs" / "cpu,cpuacct" / group / "cpu.cfs_period_us", "100000\n")
    assert list(threads._quotas(tmp_path / "self", tmp_path / "fs")) == [2.0]


def test_without_control_groups_there_is_no_quota(tmp_path: Path) -> None:
    assert list(threads._quotas(tmp_path / "self", tmp_path)) == []
    assert threads.count_threads() >= 1


@pytest.mark.parametrize("text", ["", "max", "1", "a b", "100000 0", "1e9 x"])
def test_a_file_that_is_not_a_quota_limits_nothing(tmp_path: Path, text: str) -> None:
    write(tmp_path / "self", "0::/\n")
    write(tmp_path / "fs" / "cpu.max", text)
    assert list(threads._quotas(tmp_path / "self", tmp_path / "fs")) == []


@pytest.mark.parametrize(("wish", "expected"), [("1", 1), ("3,2", 3), ("9", 4), ("0", 4), ("many", 4), ("", 4)])
def test_the_user_limits_them(monkeypatch: pytest.MonkeyPatch, wish: str, expected: int) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: {0, 1, 2, 3})
    monkeypatch.setattr(threads, "_quotas", lambda membership, mount: iter(()))
    monkeypatch.setenv("OMP_NUM_THREADS", wish)
    assert threads.count_threads() == expected


def test_a_quota_limits_the_threads_of_libraries(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: {0, 1, 2, 3})
    monkeypatch.setattr(threads, "_quotas", lambda membership, mount: iter((1.5,)))
    monkeypatch.setattr(os, "environ", {"MKL_NUM_THREADS": "1", "OMP_WAIT_POLICY": "active"})
    threads.limit_pools()
    assert os.environ.pop("OMP_WAIT_POLICY") == "active"  # as the user says
    assert os.environ == {name: "1" if name == "MKL_NUM_THREADS" else "2" for name in threads._POOLS}


def test_without_a_limit_libraries_choose(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(threads, "_quotas", lambda membership, mount: iter(()))
    monkeypatch.setattr(os, "environ", {})
    threads.limit_pools()
    assert os.environ == {"OMP_WAIT_POLICY": "passive"}
