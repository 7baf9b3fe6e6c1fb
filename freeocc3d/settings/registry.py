"""Lists the backends of a folder without importing them, loads one by name, and reads what its options are.

A backend is one file. Its docstring's first line says what it does; ``REQUIRES`` names the packages that it imports
beyond the core ones; ``Options`` is a frozen dataclass whose fields each carry a docstring. All of that is read from
the syntax tree, so that listing is instant and works where a backend's packages are not installed.
"""

from __future__ import annotations

import ast
import contextlib
import difflib
import functools
import importlib
import importlib.util
import itertools
import math
import types
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..core.errors import ConfigError, DependencyError

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
class Option:
    """One documented option: its name, annotation as written, default and docstring."""

    name: str
    type: str
    default: Any
    doc: str


@dataclass(frozen=True)
class Backend:
    """What the syntax tree of a backend's file says of it."""

    folder: str
    name: str
    summary: str
    requires: tuple[str, ...]
    options: tuple[Option, ...]

    @property
    def missing(self) -> tuple[str, ...]:
        """Required packages that are not installed."""
        return tuple(name for name in self.requires if importlib.util.find_spec(name) is None)


@functools.cache
def options_of(module: str) -> tuple[Option, ...]:
    """The fields of the ``Options`` dataclass of a module of this package, for example ``"tracking.rgbd"``."""
    return _options(_tree(module))


@functools.cache
def backends(folder: str) -> dict[str, Backend]:
    """The backends of ``folder`` (a key of FOLDERS) by name, sorted; nothing is imported."""
    found = {}
    for path in sorted(PACKAGE.joinpath(*folder.split(".")).glob("*.py")):
        if any(_assigned(node, "REQUIRES") for node in _tree(f"{folder}.{path.stem}").body):
            backend = described(folder, path.stem)
            found[backend.name] = backend
    return found


def backend(folder: str, name: str) -> Backend:
    """One of a folder's, which is not imported. Raises ConfigError for an unknown name, naming the nearest."""
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


def described(folder: str, stem: str) -> Backend:
    """What the file ``stem`` of ``folder`` says of itself; nothing is imported."""
    tree = _tree(f"{folder}.{stem}")
    requires = next((ast.literal_eval(node.value) for node in tree.body if _assigned(node, "REQUIRES")), ())  # type: ignore[attr-defined]
    summary = (ast.get_docstring(tree) or "").split("\n", 1)[0]
    return Backend(folder, stem.rstrip("_"), summary, requires, _options(tree))


def load(folder: str, name: str) -> types.ModuleType:
    """Import the backend ``name`` of ``folder``.

    Raises ConfigError for an unknown name (naming the nearest), DependencyError if a required package is missing.
    """
    if missing := backend(folder, name).missing:
        raise DependencyError(f"The {FOLDERS[folder]} '{name}' needs {', '.join(missing)}: pip install them first.")
    return importlib.import_module(f"freeocc3d.{folder}.{name}")


def build_options(module: types.ModuleType, values: Mapping[str, Any]) -> Any:
    """The module's ``Options`` made from plain values, after ``check``."""
    checked = check(_options_by_name(module.__name__.removeprefix("freeocc3d.")), values, where="")
    return module.Options(**checked)


def check(options: Mapping[str, Option], values: Mapping[str, Any], where: str) -> dict[str, Any]:
    """``values`` with defaults filled in and types checked; ``where`` is the dotted prefix used in messages.

    Raises ConfigError on an unknown key (naming the nearest) or a value of the wrong type.
    """
    for key in values:
        if key not in options:
            raise ConfigError(f"Unknown key '{where}{key}'{nearest(key, options)}.")
    return {
        name: _checked(option, values[name], where) if name in values else option.default
        for name, option in options.items()
    }


def require_positive(options: Any, *names: str) -> None:
    """Raise ConfigError unless the named fields of an ``Options`` (or None) are greater than zero."""
    for name in names:
        value = getattr(options, name)
        if value is not None and not value > 0:
            raise ConfigError(f"'{name}' must be greater than 0, got {value}.")


def nearest(word: str, known: Iterable[str], least: float = 0.5) -> str:
    """``" (did you mean 'x'?)"`` for the closest known word, or an empty string. least: of difflib's ratio, 0…1."""
    close = difflib.get_close_matches(str(word), list(known), n=1, cutoff=least)
    return f" (did you mean '{close[0]}'?)" if close else ""


def _options_by_name(module: str) -> dict[str, Option]:
    return {option.name: option for option in options_of(module)}


@functools.cache
def _tree(module: str) -> ast.Module:
    return ast.parse(PACKAGE.joinpath(*module.split(".")).with_suffix(".py").read_text(encoding="utf-8"))


def _assigned(node: ast.stmt, name: str) -> bool:
    if isinstance(node, ast.AnnAssign):
        return isinstance(node.target, ast.Name) and node.target.id == name
    return isinstance(node, ast.Assign) and any(isinstance(t, ast.Name) and t.id == name for t in node.targets)


def _options(tree: ast.Module) -> tuple[Option, ...]:
    body = next((n.body for n in tree.body if isinstance(n, ast.ClassDef) and n.name == "Options"), [])
    options = []
    for node, after in itertools.zip_longest(body, body[1:]):
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name) and node.value is not None:
            is_doc = isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant)
            doc = " ".join(str(after.value.value).split()) if is_doc else ""  # type: ignore[union-attr]
            options.append(Option(node.target.id, ast.unparse(node.annotation), ast.literal_eval(node.value), doc))
    return tuple(options)


def _checked(option: Option, value: Any, where: str) -> Any:
    for kind in option.type.split(" | "):
        fits, converted = _fit(kind, value)
        if fits:
            return converted
    with contextlib.suppress(TypeError, ValueError, OverflowError):
        if not math.isfinite(float(value)):
            raise ConfigError(f"'{where}{option.name}' must be a finite number, got {value}.")
    raise ConfigError(f"'{where}{option.name}' must be {option.type}, got {value!r} ({type(value).__name__}).")


def _fit(kind: str, value: Any) -> tuple[bool, Any]:
    if kind == "None":
        return value is None, None
    if kind == "bool":
        return isinstance(value, bool), value
    if kind == "int":
        return isinstance(value, int) and not isinstance(value, bool), value
    if kind == "float":
        if isinstance(value, str):  # YAML 1.1 takes 1e-4, without a point, for a word
            with contextlib.suppress(ValueError):
                value = float(value)
        is_number = isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
        return is_number, float(value) if is_number else value
    if kind == "str":
        return isinstance(value, str), value
    if kind.startswith("tuple["):
        inner = kind.removeprefix("tuple[").removesuffix("]").split(", ")
        if not isinstance(value, list | tuple):
            return False, value
        kinds = inner[:1] * len(value) if inner[1:] == ["..."] else inner
        fitted = [_fit(k, v) for k, v in zip(kinds, value, strict=False)]
        return len(kinds) == len(value) and all(ok for ok, _ in fitted), tuple(v for _, v in fitted)
    raise ConfigError(f"The option type '{kind}' is not supported.")
