"""Lists the backends of a folder without importing them, loads one by name, and makes its options.

A backend is one file. Its docstring's first line says what it does; ``REQUIRES`` names the packages that it imports
beyond the core ones; ``Options``, if it has any, is a class of ``typed_options`` whose fields each carry a docstring.
All of that is read from the syntax tree, so that listing is instant and works where a backend's packages are not
installed. Another package adds a backend by an entry point, whose name is the backend's and whose value is the module:
group "freeocc3d.encoders", or the same with readers, trackers, rasterizers or exporters.
"""

from __future__ import annotations

import ast
import functools
import importlib
import importlib.util
import types
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..core.errors import ConfigError, DependencyError
from . import renamed, syntax_trees
from .syntax_trees import Option
from .typed_options import build, nearest

PACKAGE = Path(__file__).parents[1]

FOLDERS = {
    "capture.readers": "capture reader",
    "tracking.trackers": "tracker",
    "gaussians.rasterizers": "rasterizer",
    "language.encoders": "encoder",
    "export": "exporter",
}
"""Folders that hold backends, and what one of them is called."""


@dataclass(frozen=True)
class Backend:
    """What the syntax tree of a backend's file says of it. module: the file's dotted name."""

    folder: str
    name: str
    module: str
    summary: str
    requires: tuple[str, ...]
    options: tuple[Option, ...]

    @property
    def missing(self) -> tuple[str, ...]:
        """Required packages that are not installed."""
        return tuple(name for name in self.requires if importlib.util.find_spec(name) is None)


@functools.cache
def backends(folder: str) -> dict[str, Backend]:
    """The backends of ``folder`` (a key of FOLDERS) by name, sorted; those of other packages follow. A name that this
    package has is its own. Nothing is imported."""
    stems = sorted(path.stem for path in PACKAGE.joinpath(*folder.split(".")).glob("*.py"))
    own = {stem.rstrip("_"): f"freeocc3d.{folder}.{stem}" for stem in stems}
    found = {name: backend for name, module in own.items() if (backend := _described(folder, name, module))}
    others = {name: _described(folder, name, module) for name, module in sorted(_added_elsewhere(folder).items())}
    return {**found, **{name: backend for name, backend in others.items() if backend and name not in found}}


def backend(folder: str, name: str) -> Backend:
    """One of a folder's, also by an earlier name; it is not imported. Raises ConfigError for an unknown name, naming
    the nearest."""
    name = renamed.current_backend(folder, name)
    found = _own(folder, name)
    if found is not None:
        return found
    known = backends(folder)
    if name not in known:
        raise ConfigError(f"Unknown {FOLDERS[folder]} '{name}'{nearest(name, known)}; there are: {', '.join(known)}.")
    return known[name]


def folder_of(kind: str) -> str:
    """The key of FOLDERS that someone means: "exporters", "exporter" and "export" are one. Raises ConfigError."""
    names = {
        name: folder
        for folder, title in FOLDERS.items()
        for name in (folder, folder.split(".")[-1], title, f"{title}s", title.split()[-1], f"{title.split()[-1]}s")
    }
    if kind not in names:
        kinds = [f"{title.split()[-1]}s" for title in FOLDERS.values()]
        raise ConfigError(f"Unknown kind '{kind}'{nearest(kind, kinds)}; there are: {', '.join(kinds)}.")
    return names[kind]


def load(folder: str, name: str) -> types.ModuleType:
    """Import the backend ``name`` of ``folder``.

    Raises ConfigError for an unknown name (naming the nearest), DependencyError if a required package is missing.
    """
    found = backend(folder, name)
    if missing := found.missing:
        raise DependencyError(f"The {FOLDERS[folder]} '{name}' needs {', '.join(missing)}: pip install them first.")
    return importlib.import_module(found.module)


def build_options(module: types.ModuleType, values: Mapping[str, Any], where: str = "") -> Any:
    """The module's ``Options`` made of plain values, None where it has none. where: what stands before a key in
    messages. Raises ConfigError: an unknown key, a value of another type or out of its range."""
    options = getattr(module, "Options", None)
    if options is not None and options.__module__ == module.__name__:  # else it is another file's, imported
        return build(options, values, where)
    if values:
        raise ConfigError(f"'{where.rstrip('.')}' has no options, got {', '.join(map(str, values))}.")
    return None


def is_backend(folder: str, name: str) -> bool:
    """Whether a folder has a backend of that name, or had one."""
    name = renamed.current_backend(folder, name)
    return _own(folder, name) is not None or name in backends(folder)


def check_names(backend: Backend, values: Mapping[str, Any], where: str) -> None:
    """Raises ConfigError for an option that a backend lacks, which is not imported."""
    known = [option.name for option in backend.options]
    for key in values:
        if key not in known:
            raise ConfigError(f"Unknown key '{where}{key}'{nearest(key, known)}.")


def _own(folder: str, name: str) -> Backend | None:
    """This package's own backend of that name, if there is one; the other files of its folder are not read."""
    for stem in (name, f"{name}_"):
        if name.isidentifier() and PACKAGE.joinpath(*folder.split("."), f"{stem}.py").is_file():
            return _described(folder, name, f"freeocc3d.{folder}.{stem}")
    return None


@functools.cache
def _described(folder: str, name: str, module: str) -> Backend | None:
    """What a module says of itself; None for one that is no backend, as it names no requirements."""
    try:
        requires = syntax_trees.assigned_value(module, "REQUIRES")
    except FileNotFoundError:
        return None
    if requires is None:
        return None
    summary, options = syntax_trees.summary_of(module), syntax_trees.options_of(module)
    return Backend(folder, name, module, summary, tuple(ast.literal_eval(requires)), options)


def _added_elsewhere(folder: str) -> dict[str, str]:
    """Name -> module of the backends that installed packages add to a folder."""
    from importlib.metadata import entry_points  # takes a tenth of a second, and is for listing and unknown names

    group = f"freeocc3d.{FOLDERS[folder].split()[-1]}s"
    return {point.name: point.module for point in entry_points(group=group)}
