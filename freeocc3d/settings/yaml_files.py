"""Reads YAML as options use it: files, and overrides such as ``occupancy.voxel_size=0.05``."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import yaml

from ..core.errors import ConfigError
from .option_types import holds_text, is_list


class _Loader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]
    """Reads 1e-4 as a number, as YAML 1.2 does; YAML 1.1 requires a decimal point."""


_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float", re.compile(r"[-+]?[0-9]+[eE][-+]?[0-9]+$"), list("-+0123456789")
)


def parse_yaml(text: str) -> Any:
    """The value of a YAML text. Raises yaml.YAMLError."""
    return yaml.load(text, Loader=_Loader)


def read_yaml(path: Path) -> dict[Any, Any]:
    """Reads the sections of a configuration file. Raises ConfigError if it is unreadable, invalid YAML or not a
    mapping."""
    try:
        loaded = parse_yaml(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(f"Cannot read the configuration {path}: {error.strerror}.") from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path} is not valid YAML: {' '.join(str(error).split())}") from error
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
    except yaml.YAMLError as error:
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
        except yaml.YAMLError as error:
            raise ConfigError(f"The value of '{name}' is not valid YAML: '{text}'.") from error
    return values
