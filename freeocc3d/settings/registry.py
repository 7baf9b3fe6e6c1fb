"""Lists the backends of a folder without importing them, loads one by name, and makes its options.

A backend is one file. The first line of its docstring says what it does. ``REQUIRES`` names the packages that it
imports in addition to the core ones. ``Options``, if it exists, is a class of ``typed_options``; each field has a
docstring. All this is read from the syntax tree, so listing is fast and works if the packages of a backend are not
installed.

Another package adds a backend by an entry point: its name is the backend's name, its value is the module, and its group
is "freeocc3d.encoders", or the same with readers, trackers, rasterizers or exporters.
"""

from __future__ import annotations

import ast
import functools
import importlib
import importlib.util
import re
import types
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..core.errors import ConfigError, DependencyError
from . import renamed, syntax_trees
from .syntax_trees import Option
from .typed_options import build, nearest, shortened

PACKAGE = Path(__file__).parents[1]

FOLDERS = {
    "capture.readers": "capture reader",
    "tracking.trackers": "tracker",
    "gaussians.rasterizers": "rasterizer",
    "language.encoders": "encoder",
    "export": "exporter",
}
"""Folder of backends -> what a message calls one of them."""
_LONGEST_NAME = 100
_ALL_EXTRAS = ("test", "benchmark", "docs", "export")


@dataclass(frozen=True)
class Backend:
    """What the syntax tree of a backend's file states. module: the file's dotted name."""

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
    """Lists the backends of ``folder`` (a key of FOLDERS) by name: those of this package, sorted, then those of other
    packages. If both have a name, it means this package's backend. Imports nothing."""
    stems = sorted(path.stem for path in PACKAGE.joinpath(*folder.split(".")).glob("*.py"))
    own = {stem.rstrip("_"): f"freeocc3d.{folder}.{stem}" for stem in stems}
    found = {name: backend for name, module in own.items() if (backend := _described(folder, name, module))}
    others = {name: _described(folder, name, module) for name, module in sorted(_added_elsewhere(folder).items())}
    return {**found, **{name: backend for name, backend in others.items() if backend and name not in found}}


def backend(folder: str, name: str) -> Backend:
    """Finds a backend by its name or an old name; does not import it. Raises ConfigError for an unknown name and
    suggests the nearest."""
    name = renamed.current_backend(folder, name)
    found = _own(folder, name)
    if found is not None:
        return found
    known = backends(folder)
    if name not in known:
        said = f"Unknown {FOLDERS[folder]} '{shortened(name)}'{nearest(name, known)}."
        raise ConfigError(f"{said} Choose from: {', '.join(known)}.")
    return known[name]


def folder_of(kind: str) -> str:
    """Finds the key of FOLDERS for a kind: "exporters", "exporter" and "export" mean the same. Raises ConfigError."""
    names = {
        name: folder
        for folder, title in FOLDERS.items()
        for name in (folder, folder.split(".")[-1], title, f"{title}s", title.split()[-1], f"{title.split()[-1]}s")
    }
    if kind not in names:
        kinds = [f"{title.split()[-1]}s" for title in FOLDERS.values()]
        raise ConfigError(f"Unknown kind '{kind}'{nearest(kind, kinds)}. Choose from: {', '.join(kinds)}.")
    return names[kind]


def load(folder: str, name: str) -> types.ModuleType:
    """Imports the backend ``name`` of ``folder``.

    Raises ConfigError for an unknown name and suggests the nearest; DependencyError if a required package is missing.
    """
    found = backend(folder, name)
    if missing := found.missing:
        wanted = " ".join(f"'freeocc3d[{extra}]'" if (extra := _extra(name)) else name for name in missing)
        raise DependencyError(f"The {FOLDERS[folder]} '{name}' needs {', '.join(missing)}: run pip install {wanted}.")
    return importlib.import_module(found.module)


def _extra(package: str) -> str:
    """The extra of this package that installs another one; empty if there is none, or if this one is not installed."""
    import importlib.metadata  # takes long, and only a message needs it

    try:
        stated = importlib.metadata.requires("freeocc3d") or []
    except importlib.metadata.PackageNotFoundError:
        return ""
    for requirement in stated:
        found = re.match(r"([\w-]+).*extra == ['\"]([\w-]+)['\"]", requirement)
        if found and found[1].lower() == package.lower() and found[2] not in _ALL_EXTRAS:
            return found[2]
    return ""


def build_options(module: types.ModuleType, values: Mapping[str, Any], where: str = "") -> Any:
    """Makes the module's ``Options`` from plain values; None if it has none. where: the text before a key in messages.
    Raises ConfigError for an unknown key and for a value of another type or out of its range."""
    options = getattr(module, "Options", None)
    if options is not None and options.__module__ == module.__name__:  # else it was imported from another file
        return build(options, values, where)
    if values:
        raise ConfigError(_without_options(values, where))
    return None


def _without_options(values: Mapping[str, Any], where: str) -> str:
    return f"'{where.rstrip('.')}' has no options. Remove {', '.join(map(shortened, values))}."


def is_backend(folder: str, name: str) -> bool:
    """Whether a folder has, or had, a backend with that name."""
    name = renamed.current_backend(folder, name)
    return _own(folder, name) is not None or name in backends(folder)


def check_names(backend: Backend, values: Mapping[str, Any], where: str) -> None:
    """Raises ConfigError for an option that a backend does not have; does not import the backend."""
    if values and not backend.options:
        raise ConfigError(_without_options(values, where))
    known = [option.name for option in backend.options]
    for key in values:
        if key not in known:
            raise ConfigError(f"Unknown key '{where}{shortened(key)}'{nearest(key, known)}.")


def _own(folder: str, name: str) -> Backend | None:
    """This package's backend with that name, or None; reads no other file of the folder."""
    for stem in (name, f"{name}_"):
        if (
            name.isidentifier()
            and len(name) <= _LONGEST_NAME
            and PACKAGE.joinpath(*folder.split("."), f"{stem}.py").is_file()
        ):
            return _described(folder, name, f"freeocc3d.{folder}.{stem}")
    return None


@functools.cache
def _described(folder: str, name: str, module: str) -> Backend | None:
    """What a module states about itself; None if it names no requirements and so is no backend."""
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
    from importlib.metadata import entry_points  # slow (0.1 s), and only listing and unknown names need it

    group = f"freeocc3d.{FOLDERS[folder].split()[-1]}s"
    return {point.name: point.module for point in entry_points(group=group)}
