"""Backends are listed from their syntax trees, loaded by name, and their options checked."""

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest

from freeocc3d.core.errors import ConfigError, DependencyError
from freeocc3d.settings import registry
from freeocc3d.settings.registry import Option

FANCY = '''"""Does something fancy.

At length."""
from dataclasses import dataclass

import a_package_that_is_not_installed

REQUIRES: tuple[str, ...] = ("a_package_that_is_not_installed", "numpy")


@dataclass(frozen=True)
class Options:
    """Its options."""

    strength: float = 0.5
    """How much,
    over two lines."""
    name: str | None = None
    sizes: tuple[int, ...] = (1, 2)
    """Sizes."""
    required: int
    offset: float = -1.5
    """Below zero."""
'''


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A package whose folder of exporters holds two backends, and two files that are none."""
    folder = tmp_path / "export"
    folder.mkdir()
    (folder / "fancy.py").write_text(FANCY)
    (folder / "npz_.py").write_text('"""Arrays."""\nREQUIRES = ()\n')
    (folder / "base.py").write_text('"""The contract."""\nclass Options:\n    size: int = 1\n')
    (folder / "__init__.py").write_text("raise RuntimeError('imported')\n")
    monkeypatch.setattr(registry, "PACKAGE", tmp_path)
    caches = registry.backends, registry.options_of, registry._tree
    for cache in caches:
        cache.cache_clear()
    yield tmp_path
    for cache in caches:
        cache.cache_clear()


def test_listing_imports_no_backend_and_no_heavy_package() -> None:
    code = """
import sys
from freeocc3d.settings import registry
names = [name for folder in registry.FOLDERS for name in registry.backends(folder)]
assert "rgbd" in names and "seven_scenes" in names, names
heavy = {"open3d", "torch", "cv2", "numba", "scipy", "pyvista", "pycolmap", "onnxruntime", "numpy"} & set(sys.modules)
assert not heavy, heavy
backends = {f"freeocc3d.{folder}" for folder in registry.FOLDERS} & set(sys.modules)
assert not backends, backends
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_a_backend_is_described_by_its_file(package: Path) -> None:
    found = registry.backends("export")
    assert list(found) == ["fancy", "npz"]
    fancy = found["fancy"]
    assert fancy.summary == "Does something fancy."
    assert fancy.requires == ("a_package_that_is_not_installed", "numpy")
    assert fancy.missing == ("a_package_that_is_not_installed",)
    assert fancy.options == (
        Option("strength", "float", 0.5, "How much, over two lines."),
        Option("name", "str | None", None, ""),
        Option("sizes", "tuple[int, ...]", (1, 2), "Sizes."),
        Option("offset", "float", -1.5, "Below zero."),
    )
    assert found["npz"].options == ()
    assert found["npz"].missing == ()


def test_an_unknown_name_names_the_nearest_and_lists_all(package: Path) -> None:
    with pytest.raises(
        ConfigError, match=r"Unknown exporter 'fency' \(did you mean 'fancy'\?\); there are: fancy, npz"
    ):
        registry.load("export", "fency")
    with pytest.raises(ConfigError, match="Unknown exporter 'zzz'; there are"):
        registry.load("export", "zzz")


@pytest.mark.parametrize("kind", ["exporters", "exporter", "export"])
def test_a_kind_of_backend_goes_by_several_names(kind: str) -> None:
    assert registry.folder_of(kind) == "export"
    assert registry.folder_of("readers") == registry.folder_of("capture reader") == "capture.readers"
    assert registry.folder_of("encoders") == "language.encoders"
    with pytest.raises(ConfigError, match=r"'exportr' \(did you mean 'exporters'\?\); there are: readers, trackers"):
        registry.folder_of("exportr")


def test_the_contract_of_a_folder_is_not_a_backend(package: Path) -> None:
    with pytest.raises(ConfigError, match="Unknown exporter 'base'"):
        registry.load("export", "base")


def test_a_missing_package_is_named_before_the_backend_is_imported(package: Path) -> None:
    with pytest.raises(DependencyError, match="'fancy' needs a_package_that_is_not_installed"):
        registry.load("export", "fancy")


def test_every_option_of_every_backend_is_documented_and_of_a_known_type() -> None:
    for folder in registry.FOLDERS:
        for backend in registry.backends(folder).values():
            assert backend.summary, backend
            for option in backend.options:
                assert option.doc, f"{folder}.{backend.name}: {option.name} has no docstring"
                registry.check({option.name: option}, {option.name: option.default}, where="")


def test_a_loaded_backend_and_its_options() -> None:
    module = registry.load("tracking.trackers", "known")
    assert module.__name__ == "freeocc3d.tracking.trackers.known"
    assert registry.build_options(module, {"keyframe_overlap": 1}).keyframe_overlap == 1.0
    with pytest.raises(ConfigError, match=r"'keyframe_overlop' \(did you mean 'keyframe_overlap'\?\)"):
        registry.build_options(module, {"keyframe_overlop": 0.5})


def test_defaults_are_filled_in() -> None:
    options = {"a": Option("a", "int", 3, ""), "b": Option("b", "str", "x", "")}
    assert registry.check(options, {"b": "y"}, where="") == {"a": 3, "b": "y"}


@pytest.mark.parametrize(
    ("kind", "value", "expected"),
    [
        ("int", 3, 3),
        ("float", 2, 2.0),
        ("bool", False, False),
        ("str", "7", "7"),
        ("int | None", None, None),
        ("float | None", 1, 1.0),
        ("str | tuple[int, ...]", [1, 2], (1, 2)),
        ("tuple[float, float]", [1, 2.5], (1.0, 2.5)),
        ("tuple[str, ...]", [], ()),
    ],
)
def test_values_that_fit(kind: str, value: object, expected: object) -> None:
    found = registry.check({"x": Option("x", kind, None, "")}, {"x": value}, where="")["x"]
    assert found == expected
    assert type(found) is type(expected)


@pytest.mark.parametrize(
    ("kind", "value"),
    [
        ("int", 3.0),
        ("int", True),
        ("int", "3"),
        ("int", None),
        ("float", True),
        ("float", float("nan")),
        ("float", float("inf")),
        ("bool", 1),
        ("str", 7),
        ("tuple[float, float]", [1.0]),
        ("tuple[float, float]", [1.0, 2.0, 3.0]),
        ("tuple[int, ...]", [1, "2"]),
        ("tuple[str, ...]", "abc"),
    ],
)
def test_values_that_do_not_fit_are_refused_with_their_place(kind: str, value: object) -> None:
    with pytest.raises(ConfigError, match=r"^'layer\.x' must be "):
        registry.check({"x": Option("x", kind, None, "")}, {"x": value}, where="layer.")


def test_options_of_a_module_that_is_no_backend(package: Path) -> None:
    assert registry.options_of("export.base") == (Option("size", "int", 1, ""),)
    module = SimpleNamespace(__name__="freeocc3d.export.base", Options=lambda **given: given)
    assert registry.build_options(module, {}) == {"size": 1}  # type: ignore[arg-type]
