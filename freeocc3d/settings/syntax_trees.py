"""Reads what a module states about itself from its syntax tree, so that the module and its packages are not
imported."""

from __future__ import annotations

import ast
import functools
import importlib.util
import itertools
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from .option_types import annotated_type, described, is_advanced

_OPTIONS = "Options"
_ROOT = "freeocc3d"
_PACKAGE = Path(__file__).parents[1]


@dataclass(frozen=True)
class Option:
    """An option as its class declares it. type: in words.  kind: the type itself; its source text if unknown.  doc: its
    docstring.  advanced: whether it is only for comparisons with other methods."""

    name: str
    type: str
    default: Any
    doc: str
    advanced: bool = False
    kind: Any = None


def path_of(module: str) -> Path | None:
    """Finds the file of a module by its dotted name, without importing it; None if it has no readable file."""
    top, *rest = module.split(".")
    if top == _ROOT:
        folder = _PACKAGE
    else:
        found = importlib.util.find_spec(top)
        if found is None or found.origin is None:
            return None
        folder = Path(found.origin).parent if found.submodule_search_locations else Path(found.origin)
    if folder.is_file():
        return None if rest else folder
    path = folder.joinpath(*rest)
    candidates = (path / "__init__.py", path.with_name(path.name + ".py"))
    return next((candidate for candidate in candidates if candidate.is_file()), None)


@functools.cache
def tree_of(module: str) -> ast.Module:
    """The syntax tree of a module, by its dotted name. Raises FileNotFoundError."""
    path = path_of(module)
    if path is None:
        raise FileNotFoundError(module)
    return ast.parse(path.read_text(encoding="utf-8"))


def summary_of(module: str) -> str:
    """The first line of a module's docstring."""
    return (ast.get_docstring(tree_of(module)) or "").split("\n", 1)[0]


def assigned_value(module: str, name: str) -> ast.expr | None:
    """The expression that a module assigns to a name at its top level, or None."""
    return _assigned(tree_of(module)).get(name)


@functools.cache
def options_of(module: str, class_name: str = _OPTIONS) -> tuple[Option, ...]:
    """The options that a class in a module's own file declares and inherits; none if the class does not exist."""
    classes = [node for node in tree_of(module).body if isinstance(node, ast.ClassDef) and node.name == class_name]
    options: dict[str, Option] = {}
    for node in classes:
        for base in node.bases:
            if isinstance(base, ast.Name):
                options |= {option.name: option for option in _inherited(module, base.id)}
        options |= _declared(node, module, options)
    return tuple(options.values())


def _inherited(module: str, class_name: str) -> tuple[Option, ...]:
    """The options of a class that a module declares or imports."""
    origin = _imported_from(tree_of(module), module, class_name)
    if origin is None:
        return options_of(module, class_name)
    return options_of(*origin) if path_of(origin[0]) is not None else ()


def _declared(node: ast.ClassDef, module: str, inherited: dict[str, Option]) -> dict[str, Option]:
    """The options in a class's own body; an option that overrides another and has no docstring keeps the inherited
    one."""
    options = {}
    for statement, after in itertools.zip_longest(node.body, node.body[1:]):
        if isinstance(statement, ast.AnnAssign) and isinstance(statement.target, ast.Name) and statement.value:
            name = statement.target.id
            is_doc = isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant)
            doc = " ".join(str(after.value.value).split()) if is_doc else ""  # type: ignore[union-attr]
            if not doc and name in inherited:
                doc = inherited[name].doc
            names = {part.id for part in ast.walk(statement.annotation) if isinstance(part, ast.Name)}
            aliases = {name: alias for name in names if (alias := _alias(module, name)) is not None}
            kind = annotated_type(statement.annotation, aliases)
            default = ast.literal_eval(statement.value)
            options[name] = Option(name, described(kind), default, doc, is_advanced(kind), kind)
    return options


def _alias(module: str, name: str) -> ast.expr | None:
    """The expression that a module, or the module from which it imports the name, assigns to a name."""
    found = assigned_value(module, name)
    origin = _imported_from(tree_of(module), module, name) if found is None else None
    return found if origin is None or path_of(origin[0]) is None else assigned_value(*origin)


def _assigned(tree: ast.Module) -> dict[str, ast.expr]:
    found: dict[str, ast.expr] = {}
    for node in tree.body:
        targets = (
            node.targets if isinstance(node, ast.Assign) else [node.target] if isinstance(node, ast.AnnAssign) else []
        )
        found |= {target.id: node.value for target in targets if isinstance(target, ast.Name) and node.value}  # type: ignore[attr-defined]
    return found


def _imported_from(tree: ast.Module, module: str, name: str) -> tuple[str, str] | None:
    """The module and name behind a name that a module imports."""
    for node in tree.body:
        if isinstance(node, ast.ImportFrom):
            for alias in node.names:
                if (alias.asname or alias.name) == name:
                    path = path_of(module)
                    depth = node.level - (path is not None and path.name == "__init__.py")
                    parts = module.split(".")[: len(module.split(".")) - depth] if node.level else []
                    return ".".join([*parts, *([node.module] if node.module else [])]), alias.name
    return None
