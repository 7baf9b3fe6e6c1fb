"""Strict YAML in (an unknown key is an error that names the nearest), resolved YAML out.

A configuration is a mapping section -> key -> value. The sections and their keys are the ``Options`` dataclasses of the
layers, read from their syntax trees; a layer with backends has one sub-section per backend that is configured.
"""

from __future__ import annotations

import hashlib
import json
import textwrap
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import yaml

from ..core.errors import ConfigError
from . import registry
from .presets import find_preset
from .registry import Option

SECTIONS: dict[str, tuple[str, str | None]] = {
    "capture": ("capture.base", "capture.readers"),
    "tracking": ("tracking.base", "tracking.trackers"),
    "gaussians": ("gaussians.anchors", None),
    "fitting": ("gaussians.fitting", "gaussians.rasterizers"),
    "language": ("language.lifting", "language.encoders"),
    "vocabulary": ("language.scene_vocabulary", None),
    "occupancy": ("occupancy.splat", None),
    "carving": ("occupancy.carve", None),
}
"""Section -> (module whose ``Options`` it configures, folder of its backends)."""

NESTED: dict[str, dict[str, str]] = {"tracking": {"stereo": "depth.multi_view_stereo"}}
"""Section -> what it holds besides its backends -> module whose ``Options`` that configures."""

Config = dict[str, dict[str, Any]]


def default() -> Config:
    """Every key of every layer with its default."""
    return resolve({})


def load(path: Path | None, overrides: Iterable[str] = ()) -> Config:
    """The configuration of a YAML file or of a preset (``mono``), or the defaults, with overrides applied.

    path: None = the defaults.  overrides: ``section.key=value``.
    Raises ConfigError: unreadable or invalid YAML, unknown key, wrong type, malformed override.
    """
    values: dict[str, Any] = {}
    if path is not None:
        path = find_preset(path)
        try:
            loaded = yaml.safe_load(path.read_text(encoding="utf-8"))
        except OSError as error:
            raise ConfigError(f"Cannot read the configuration {path}: {error.strerror}.") from error
        except (yaml.YAMLError, UnicodeDecodeError) as error:
            raise ConfigError(f"{path} is not valid YAML: {' '.join(str(error).split())}") from error
        if loaded is not None and not isinstance(loaded, dict):
            raise ConfigError(f"{path} must hold sections such as 'tracking:', not a {type(loaded).__name__}.")
        values = loaded or {}
        try:
            resolve(values)
        except ConfigError as error:
            raise ConfigError(f"{path}: {error}") from error
    for override in overrides:
        _apply(values, override)
    return resolve(values)


def resolve(values: Mapping[str, Any]) -> Config:
    """``values`` checked and with all defaults filled in. Raises ConfigError."""
    for section in values:
        if section not in SECTIONS:
            raise ConfigError(f"Unknown section '{section}'{registry.nearest(section, SECTIONS)}.")
    config: Config = {}
    for section, (module, folder) in SECTIONS.items():
        given = values.get(section) or {}
        if not isinstance(given, dict):
            raise ConfigError(f"Section '{section}' must hold 'key: value' lines, got {given!r}.")
        options = {option.name: option for option in registry.options_of(module)}
        backends = _subsections(section, folder)
        own = {key: value for key, value in given.items() if key not in backends}
        known = {**options, **{name: Option(name, "dict", {}, "") for name in backends}}
        for key in own:
            if key not in options:
                raise ConfigError(f"Unknown key '{section}.{key}'{registry.nearest(key, known)}.")
        config[section] = registry.check(options, own, f"{section}.")
        for name, backend in backends.items():
            sub = given.get(name) or {}
            if not isinstance(sub, dict):
                raise ConfigError(f"'{section}.{name}' must hold 'key: value' lines, got {sub!r}.")
            if backend.options:
                fields = {option.name: option for option in backend.options}
                config[section][name] = registry.check(fields, sub, f"{section}.{name}.")
            elif sub:
                raise ConfigError(f"'{section}.{name}' has no options, got {', '.join(map(str, sub))}.")
    return config


def options(config: Config, section: str) -> dict[str, Any]:
    """The section's own keys, without its backends'."""
    names = {option.name for option in registry.options_of(SECTIONS[section][0])}
    return {key: value for key, value in config[section].items() if key in names}


def dump(config: Config) -> str:
    """Resolved YAML; ``load`` of it gives the same configuration back."""
    plain = json.loads(json.dumps(config))  # tuples become lists
    return yaml.safe_dump(plain, sort_keys=False)


def documented() -> str:
    """YAML with every key, its default and what it does: what ``configs/default.yaml`` holds."""
    lines = ["# Every option with its default. A file of your own needs only the keys that it changes."]
    for section, (module, folder) in SECTIONS.items():
        lines += ["", f"{section}:"]
        for option in registry.options_of(module):
            lines += _documented(option, indent=2)
        for name, backend in _subsections(section, folder).items():
            if backend.options:
                lines.append(f"  {name}:  # {backend.summary}")
                for option in backend.options:
                    lines += _documented(option, indent=4)
    return "\n".join(lines) + "\n"


def _subsections(section: str, folder: str | None) -> dict[str, registry.Backend]:
    """What has keys of its own in a section: its backends, and what is nested in it."""
    nested = {name: registry.described(*module.rsplit(".", 1)) for name, module in NESTED.get(section, {}).items()}
    return {**(registry.backends(folder) if folder else {}), **nested}


def _documented(option: Option, indent: int) -> list[str]:
    value = json.dumps(option.default)
    comment = textwrap.wrap(option.doc, 118 - indent)
    return [" " * indent + f"# {line}" for line in comment] + [" " * indent + f"{option.name}: {value}"]


def fingerprint(config: Config, sections: Iterable[str]) -> str:
    """A hash of some sections: a saved stage is reused only while it is unchanged."""
    text = json.dumps({name: config[name] for name in sections}, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _apply(values: dict[str, Any], override: str) -> None:
    name, separator, text = override.partition("=")
    keys = name.strip().split(".")
    if not separator or len(keys) < 2 or not all(keys):
        raise ConfigError(f"An override reads section.key=value, got '{override}'.")
    try:
        value = yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise ConfigError(f"The value in '{override}' is not valid YAML.") from error
    node = values
    for key in keys[:-1]:
        child = node.get(key)
        if child is None:
            child = node[key] = {}
        if not isinstance(child, dict):
            raise ConfigError(f"'{override}' does not fit: '{key}' holds a value, not a section.")
        node = child
    node[keys[-1]] = value
