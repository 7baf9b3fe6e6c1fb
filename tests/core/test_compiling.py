"""Kernels are kept, read from an installation, compiled again after a change, and work where nothing can be kept."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import pytest

from freeocc3d.core import compiling, portable_kernels

CALLED = "from freeocc3d.core.compiling import njit\n@njit(cache=True)\ndef add(a):\n    return a + 1\n"
CALLING = (
    "from freeocc3d.core.compiling import njit\nfrom {called} import add, STEP\n"
    "@njit(cache=True)\ndef twice(a):\n    return add(add(a)) * STEP\n"
)


def load(name: str, path: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def kernel(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Writes two files, of which one calls the other, and loads them as a new process would."""
    names = f"called_{tmp_path.name}", f"calling_{tmp_path.name}"

    def loaded(called: str = CALLED, step: int = 1):
        compiling._hash_source.cache_clear()
        (tmp_path / f"{names[0]}.py").write_text(called + f"STEP = {step}\n")
        (tmp_path / f"{names[1]}.py").write_text(CALLING.format(called=names[0]))
        load(names[0], tmp_path / f"{names[0]}.py")
        return load(names[1], tmp_path / f"{names[1]}.py").twice

    yield loaded
    for name in names:
        sys.modules.pop(name, None)


def was_cached(dispatcher) -> bool:
    return sum(dispatcher.stats.cache_hits.values()) == 1


def test_kernels_are_kept(kernel, tmp_path: Path) -> None:
    assert kernel()(1) == 3
    assert list((tmp_path / "__pycache__").glob("calling*.nbc"))
    again = kernel()
    assert again(1) == 3
    assert was_cached(again)


@pytest.mark.parametrize(
    ("change", "expected"), [({"called": CALLED.replace("+ 1", "+ 2")}, 5), ({"step": 10}, 30)], ids=["call", "number"]
)
def test_a_change_in_an_imported_file_compiles_again(kernel, change: dict, expected: int) -> None:
    assert kernel()(1) == 3
    assert kernel(**change)(1) == expected


def test_kernels_of_a_read_only_installation_are_read(kernel, monkeypatch: pytest.MonkeyPatch) -> None:
    assert kernel()(1) == 3
    monkeypatch.setattr(compiling, "find_writable_folder", lambda source: None)
    again = kernel()
    assert again(1) == 3
    assert was_cached(again)
    assert again(1.5) == 3.5  # a signature that was not kept


def test_portable_kernels_are_read_by_processors_of_their_level(
    kernel, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(compiling, "FOLDER", tmp_path / "portable")
    monkeypatch.setattr(compiling, "runs_here", lambda: True)
    ahead = kernel()
    ahead._cache = compiling.open_portable(ahead.py_func)
    assert ahead(1) == 3
    assert list((tmp_path / "portable").rglob("calling*.nbc"))
    assert not list((tmp_path / "__pycache__").glob("calling*.nbc"))
    found = kernel()
    assert found(1) == 3
    assert was_cached(found)
    monkeypatch.setattr(compiling, "runs_here", lambda: False)
    elsewhere = kernel()
    assert elsewhere(1) == 3
    assert not was_cached(elsewhere)
    monkeypatch.setattr(compiling, "runs_here", lambda: True)
    assert kernel(step=10)(1) == 30


def test_the_level_of_processors_is_told_by_their_features(monkeypatch: pytest.MonkeyPatch) -> None:
    features = {name[1:]: True for name in portable_kernels.CPU_FEATURES.split(",")}
    monkeypatch.setattr(portable_kernels.platform, "machine", lambda: "x86_64")
    monkeypatch.setattr(portable_kernels.binding, "get_host_cpu_features", lambda: features)
    monkeypatch.delenv("NUMBA_CPU_NAME", raising=False)
    ask = portable_kernels.runs_here.__wrapped__
    assert ask()
    features["fma"] = False
    assert not ask()


def test_they_work_where_nothing_can_be_kept(kernel, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compiling, "find_writable_folder", lambda source: None)
    assert kernel()(1) == 3
    assert not list(tmp_path.rglob("*.nb*"))


@pytest.mark.parametrize("content", [b"", b"no pickle", b"\x80\x04N."])
@pytest.mark.parametrize("kind", ["nbi", "nbc"])
def test_damaged_files_are_no_error(kernel, tmp_path: Path, kind: str, content: bytes) -> None:
    assert kernel()(1) == 3
    for file in (tmp_path / "__pycache__").glob(f"*.{kind}"):
        file.write_bytes(content)
    assert kernel()(1) == 3
    assert kernel()(1) == 3


def test_a_full_disk_is_no_error(kernel, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*arguments: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(compiling.FunctionCache, "save_overload", fail)
    assert kernel()(1) == 3
