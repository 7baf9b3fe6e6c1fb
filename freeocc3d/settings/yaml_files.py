"""Reads YAML as options use it: files, and overrides such as ``occupancy.voxel_size=0.05``."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from ..core import yaml_documents
from ..core.errors import ConfigError
from ..core.regular_files import read_bytes
from ..core.typed_documents import InvalidDocument
from .option_types import holds_text, is_list

_MOST_BYTES = 16 << 20

_FLOAT = re.compile(r"[-+]?[0-9]+[eE][-+]?[0-9]+")
"""1e-4 is a number, as in YAML 1.2; YAML 1.1 requires a decimal point."""


def parse_yaml(text: str | bytes) -> Any:
    """The value of a YAML text. Raises InvalidDocument."""
    return yaml_documents.parse_yaml(text, _FLOAT.fullmatch)


def read_yaml(path: Path) -> dict[Any, Any]:
    """Reads the sections of a configuration file. Raises ConfigError if it is unreadable, invalid YAML or not a
    mapping."""
    try:
        loaded = parse_yaml(read_bytes(path, _MOST_BYTES))
    except OSError as error:
        raise ConfigError(f"Cannot read the configuration {path}: {error.strerror}.") from error
    except InvalidDocument as error:
        raise ConfigError(f"{path} is not valid YAML: {error}.") from error
    if loaded is not None and not isinstance(loaded, dict):
        raise ConfigError(f"{path} must contain sections such as 'tracking:', got a {type(loaded).__name__}.")
    return loaded or {}


def apply_override(values: dict[Any, Any], override: str) -> None:
    """Sets ``section.key=value`` in nested ``values``. Raises ConfigError if it is malformed."""
    name, separator, text = override.partition("=")
    keys = name.strip().split(".")
    if not separator or len(keys) < 2 or not all(keys):
        raise ConfigError(f"An override has the form section.key=value, got '{override}'.")
    try:
        value = parse_yaml(text)
    except InvalidDocument as error:
        raise ConfigError(f"The value in '{override}' is not valid YAML.") from error
    node = values
    for key in keys[:-1]:
        child = node.get(key)
        if child is None:
            child = node[key] = {}
        if not isinstance(child, dict):
            raise ConfigError(f"Cannot apply the override '{override}': '{key}' is a value, not a section.")
        node = child
    node[keys[-1]] = value


def named_values(assignments: Iterable[str], kinds: Mapping[str, Any]) -> dict[str, Any]:
    """Reads values by name from ``name=value`` in YAML; a list needs no brackets.

    kinds: name -> type of the options (see ``option_types``). Raises ConfigError for another form.
    """
    values = {}
    for assignment in assignments:
        name, separator, text = (part.strip() for part in assignment.partition("="))
        if not separator:
            raise ConfigError(f"An option has the form name=value, got '{assignment}'.")
        kind = kinds.get(name)
        try:
            if not is_list(kind) or text[:1] in ("[", "") or text == "null":
                values[name] = parse_yaml(text)
            else:
                items = [part.strip() for part in text.split(",")]
                values[name] = items if holds_text(kind) else [parse_yaml(item) for item in items]
        except InvalidDocument as error:
            raise ConfigError(f"The value of '{name}' is not valid YAML: '{text}'.") from error
    return values
