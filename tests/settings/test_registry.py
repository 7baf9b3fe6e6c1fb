"""Backends are listed from their syntax trees, loaded by name, and their options checked."""

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from freeocc3d.core.errors import ConfigError, DependencyError
from freeocc3d.settings import registry, syntax_trees
from freeocc3d.settings.option_types import converted, described
from freeocc3d.settings.typed_options import TypedOptions, field_types

FANCY = '''"""Does something fancy.

At length."""
from typing import Literal

import a_package_that_is_not_installed

from freeocc3d.settings.option_types import Advanced, Finite, Positive
from .shapes import Form, SizeOptions

REQUIRES: tuple[str, ...] = ("a_package_that_is_not_installed", "numpy")


class Options(SizeOptions, frozen=True):
    """Its options."""

    strength: Positive = 0.5
    """How much,
    over two lines."""
    name: str | None = None
    required: int
    offset: Advanced[Finite] = -1.5
    """Below zero."""
    form: Form = "flat"
    edge: Positive = 2.0
'''


SHAPES = """from typing import Literal

Form = Literal["flat", "round"]


class SizeOptions:
    sizes: tuple[int, ...] = (1, 2)
    \"\"\"Sizes.\"\"\"
    edge: float = 1.0
    \"\"\"Longest edge.\"\"\"
"""


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A package whose folder of exporters holds two backends, and two files that are none."""
    folder = tmp_path / "export"
    folder.mkdir()
    (folder / "fancy.py").write_text(FANCY)
    (folder / "npz_.py").write_text('"""Arrays."""\nREQUIRES = ()\n')
    (folder / "shapes.py").write_text(SHAPES)
    (folder / "base.py").write_text('"""The contract."""\nclass Options:\n    size: int = 1\n')
    (folder / "__init__.py").write_text("raise RuntimeError('imported')\n")
    monkeypatch.setattr(registry, "PACKAGE", tmp_path)
    monkeypatch.setattr(syntax_trees, "_PACKAGE", tmp_path)
    caches = registry.backends, registry._described, syntax_trees.options_of, syntax_trees.tree_of
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
    assert [(o.name, o.type, o.default, o.doc, o.advanced) for o in fancy.options] == [
        ("sizes", "a list of whole numbers", (1, 2), "Sizes.", False),
        ("edge", "a number greater than 0", 2.0, "Longest edge.", False),
        ("strength", "a number greater than 0", 0.5, "How much, over two lines.", False),
        ("name", "text or null", None, "", False),
        ("offset", "a number", -1.5, "Below zero.", True),
        ("form", "flat or round", "flat", "", False),
    ]
    assert found["npz"].options == ()
    assert found["npz"].missing == ()


def test_an_unknown_name_names_the_nearest_and_lists_all(package: Path) -> None:
    with pytest.raises(
        ConfigError, match=r"Unknown exporter 'fency' \(did you mean 'fancy'\?\)\. Choose from: fancy, npz"
    ):
        registry.load("export", "fency")
    with pytest.raises(ConfigError, match=r"Unknown exporter 'zzz'\. Choose from"):
        registry.load("export", "zzz")


@pytest.mark.parametrize("kind", ["exporters", "exporter", "export"])
def test_a_kind_of_backend_goes_by_several_names(kind: str) -> None:
    assert registry.folder_of(kind) == "export"
    assert registry.folder_of("readers") == registry.folder_of("capture reader") == "capture.readers"
    assert registry.folder_of("encoders") == "language.encoders"
    with pytest.raises(ConfigError, match=r"'exportr' \(did you mean 'exporters'\?\). Choose from: readers, trackers"):
        registry.folder_of("exportr")


def test_the_contract_of_a_folder_is_not_a_backend(package: Path) -> None:
    with pytest.raises(ConfigError, match="Unknown exporter 'base'"):
        registry.load("export", "base")


def test_a_missing_package_is_named_before_the_backend_is_imported(package: Path) -> None:
    with pytest.raises(DependencyError, match="'fancy' needs a_package_that_is_not_installed"):
        registry.load("export", "fancy")


BACKENDS = [(folder, name) for folder in registry.FOLDERS for name in registry.backends(folder)]


@pytest.mark.parametrize(("folder", "name"), BACKENDS)
def test_every_option_of_every_backend_is_documented_and_its_default_fits(folder: str, name: str) -> None:
    backend = registry.backend(folder, name)
    assert backend.summary
    for option in backend.options:
        assert option.doc, f"{option.name} has no docstring"
        assert not isinstance(option.kind, str), f"the type of {option.name} cannot be read: {option.kind}"
        converted(option.kind, option.default, option.name)


@pytest.mark.parametrize(("folder", "name"), BACKENDS)
def test_the_syntax_tree_says_what_the_class_is(folder: str, name: str) -> None:
    backend = registry.backend(folder, name)
    if backend.missing:
        pytest.skip(f"needs {backend.missing}")
    options = registry.build_options(registry.load(folder, name), {})
    if options is None:
        assert backend.options == ()
        return
    assert isinstance(options, TypedOptions)
    assert options.to_dict() == {option.name: option.default for option in backend.options}
    types = field_types(type(options))
    assert {option.name: option.type for option in backend.options} == {
        option: described(kind) for option, kind in types.items()
    }
    numbers = [kind for kind in types.values() if "number" in described(kind)]
    for kind in numbers:  # every number has a range, so that none can be infinite
        for value in (float("inf"), [float("inf")] * 2):
            with pytest.raises(ConfigError):
                converted(kind, value, "x")


def test_a_loaded_backend_and_its_options() -> None:
    module = registry.load("tracking.trackers", "known")
    assert module.__name__ == "freeocc3d.tracking.trackers.known"
    assert registry.build_options(module, {"keyframe_overlap": 1}).keyframe_overlap == 1.0
    with pytest.raises(ConfigError, match=r"'keyframe_overlop' \(did you mean 'keyframe_overlap'\?\)"):
        registry.build_options(module, {"keyframe_overlop": 0.5})


def test_options_of_a_backend_that_has_none() -> None:
    module = registry.load("gaussians.rasterizers", "cpu")
    assert registry.build_options(module, {}) is None
    with pytest.raises(ConfigError, match=r"'fitting\.cpu' has no options\. Remove device"):
        registry.build_options(module, {"device": "cpu"}, "fitting.cpu.")


def test_options_that_a_reader_takes_from_elsewhere_are_not_its_own() -> None:
    assert registry.backend("capture.readers", "replica").options == ()
    assert registry.build_options(registry.load("capture.readers", "replica"), {}) is None
