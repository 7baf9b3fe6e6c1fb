"""Configurations: an unknown key is an error that suggests the nearest one; values are typed once and written as YAML.

A configuration file is a mapping section -> key -> value. Each section is a class of ``stages``. The options of its
backends are in one sub-section for each, under the backend's name.
"""

from __future__ import annotations

import copy
import hashlib
import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec

from ..core.errors import ConfigError
from ..core.warnings import Notice
from ..core.yaml_documents import dump_yaml
from . import registry, renamed, stages
from .option_types import clamped, converted, shown
from .presets import find_preset
from .typed_options import TypedOptions, build, field_types, nearest, shortened
from .yaml_files import apply_override, read_yaml

BackendValues = dict[str, dict[str, Any]]
"""Name of a backend -> the values given for its options."""


@dataclass(frozen=True)
class Section:
    """A section of a configuration file. folder: that of its backends.  choice: the option that selects one of them.
    within: the section that contains this one; empty = the file itself."""

    options: type[TypedOptions]
    folder: str = ""
    choice: str = ""
    within: str = ""


SECTIONS: dict[str, Section] = {
    "capture": Section(stages.CaptureOptions, "capture.readers", "format"),
    "tracking": Section(stages.TrackingOptions, "tracking.trackers", "backend"),
    "stereo": Section(stages.StereoOptions, within="tracking"),
    "gaussians": Section(stages.GaussianOptions),
    "fitting": Section(stages.FittingOptions, "gaussians.rasterizers", "rasterizer"),
    "language": Section(stages.LanguageOptions, "language.encoders", "encoder"),
    "vocabulary": Section(stages.VocabularyOptions),
    "occupancy": Section(stages.OccupancyOptions),
    "carving": Section(stages.CarvingOptions),
}
"""Field of ``Settings`` -> its section of a file."""


class Settings(msgspec.Struct, frozen=True):
    """A resolved configuration: the options of every stage, and the values given for backends."""

    capture: stages.CaptureOptions
    tracking: stages.TrackingOptions
    stereo: stages.StereoOptions
    gaussians: stages.GaussianOptions
    fitting: stages.FittingOptions
    language: stages.LanguageOptions
    vocabulary: stages.VocabularyOptions
    occupancy: stages.OccupancyOptions
    carving: stages.CarvingOptions
    backends: dict[str, BackendValues] = {}
    """Section -> the values given for its backends; other options have their defaults."""
    notices: tuple[Notice, ...] = ()
    """Warnings about names that changed, and about values of an older map that are out of today's ranges."""

    def changed(self, section: str, **values: Any) -> Settings:
        """Returns a copy with other values in a section (a field of this class). Raises ConfigError."""
        return msgspec.structs.replace(self, **{section: getattr(self, section).changed(**values)})

    def with_backend(self, section: str, **values: Any) -> Settings:
        """Returns a copy with other values for the selected backend of a section. Raises ConfigError."""
        name, backends = self.chosen(section), copy.deepcopy(self.backends)
        given = {**backends.get(section, {}).get(name, {}), **values}
        backends.setdefault(section, {})[name] = _checked(section, name, given)
        return msgspec.structs.replace(self, backends=backends)

    def has_backend_option(self, section: str, name: str) -> bool:
        """Whether the selected backend of a section has an option; false if the selection is left open."""
        if self.chosen(section) == "auto":
            return False
        backend = registry.backend(SECTIONS[section].folder, self.chosen(section))
        return any(option.name == name for option in backend.options)

    def chosen(self, section: str) -> str:
        """The name of the selected backend of a section."""
        return str(getattr(getattr(self, section), SECTIONS[section].choice))

    def backend(self, section: str) -> tuple[Any, Any]:
        """The module of the selected backend of a section, and its options (None if it has none).

        Raises ConfigError for an unknown name or option, DependencyError if its packages are not installed.
        """
        name = self.chosen(section)
        module = registry.load(SECTIONS[section].folder, name)
        return module, registry.build_options(module, self.given(section, name), f"{section}.{name}.")

    def load_backend(self, section: str, *arguments: Any) -> Any:
        """Makes the selected backend of a section from its own options and the arguments that its kind takes."""
        module, options = self.backend(section)
        return module.load(*arguments) if options is None else module.load(options, *arguments)

    def given(self, section: str, name: str) -> dict[str, Any]:
        """The values given for a backend."""
        return self.backends.get(section, {}).get(name, {})

    def to_dict(self) -> dict[str, dict[str, Any]]:
        """Plain values as in a file: every option of the stages and of the backends that are selected or given."""
        plain: dict[str, dict[str, Any]] = {}
        for name, section in SECTIONS.items():
            values = getattr(self, name).to_dict()
            if section.within:
                plain[section.within][name] = values
                continue
            plain[name] = values
            if section.folder:
                plain[name] |= self._backends_of(name)
        return plain

    def _backends_of(self, section: str) -> BackendValues:
        """The options of a section's backends that are selected or given; of all backends if the selection is
        "auto"."""
        folder, chosen, given = SECTIONS[section].folder, self.chosen(section), self.backends.get(section, {})
        names = dict.fromkeys([*(registry.backends(folder) if chosen == "auto" else [chosen]), *given])
        found: BackendValues = {}
        for name in names:
            defaults = {option.name: option.default for option in registry.backend(folder, name).options}
            if defaults:
                found[name] = {**defaults, **given.get(name, {})}
        return found


def load(path: Path | None, overrides: Iterable[str] = ()) -> Settings:
    """Reads a configuration from a YAML file or a preset (``mono``), and applies overrides.

    path: None = the defaults.  overrides: ``section.key=value``.
    Raises ConfigError for YAML that is unreadable or invalid, an unknown key, a value of another type or out of its
    range, and a malformed override.
    """
    values: dict[Any, Any] = {}
    if path is not None:
        path = find_preset(path)
        values = read_yaml(path)
        try:
            resolved = resolve(values)
        except ConfigError as error:
            raise ConfigError(f"{path}: {error}") from error
        if not (overrides := list(overrides)):
            return resolved
    for override in overrides:
        apply_override(values, override)
    return resolve(values)


def load_saved(path: Path, overrides: Iterable[str] = ()) -> Settings:
    """Reads the configuration that a map was made with; overrides are as in ``load``.

    Numbers that an earlier release took and that are out of today's ranges count as the nearest end of them; a notice
    says so. Options of backends that it does not select are left out; those of the selected ones are checked when the
    backends are used. Raises ConfigError.
    """
    try:
        saved = _resolve(read_yaml(path), saved=True)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from error
    values: dict[Any, Any] = saved.to_dict()
    overrides = list(overrides)
    for override in overrides:
        apply_override(values, override)
    return msgspec.structs.replace(resolve(values), notices=saved.notices) if overrides else saved


def resolve(values: Mapping[str, Any] | Settings) -> Settings:
    """Checks ``values`` and fills in all defaults. Raises ConfigError."""
    if isinstance(values, Settings):
        return values
    if not isinstance(values, Mapping):
        raise ConfigError(
            f"Settings are a mapping of sections, such as {{'occupancy': {{'voxel_size': 0.05}}}}, got "
            f"{shown(values)}. freeocc3d.settings.config.load reads a file or a preset."
        )
    return _resolve(values, saved=False)


def dump(settings: Settings) -> str:
    """Resolved YAML; ``load`` reads the same configuration back."""
    plain = json.loads(json.dumps(settings.to_dict()))  # tuples become lists
    return dump_yaml(plain)


def fingerprint(settings: Settings, sections: Iterable[str], *identity: Any) -> str:
    """A hash of some sections and of other values that a saved stage depends on. A saved stage with the same hash is
    reused."""
    plain = settings.to_dict()
    text = json.dumps([{name: plain[name] for name in sections}, identity], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _resolve(values: Mapping[Any, Any], saved: bool) -> Settings:
    """saved: the values come from a map's file, so old names give no warning, and numbers are brought into range."""
    outer = [name for name, section in SECTIONS.items() if not section.within]
    for name in values:
        if name not in outer:
            raise ConfigError(f"Unknown section '{shortened(name)}'{nearest(name, outer)}.")
    found: dict[str, Any] = {"backends": {}}
    notices: list[Notice] = []
    out_of_range: list[Notice] = []
    for name in outer:
        section, where = SECTIONS[name], f"{name}."
        given = renamed.current_keys(_section(values, name), where, notices)
        nested = [inner for inner, other in SECTIONS.items() if other.within == name]
        for inner in nested:
            below = renamed.current_keys(_lines(given.pop(inner, None), where + inner), f"{where}{inner}.", notices)
            if saved:
                below = _in_range(SECTIONS[inner].options, below, f"{where}{inner}.", out_of_range)
            found[inner] = build(SECTIONS[inner].options, below, f"{where}{inner}.")
        own, backends = _divided(name, given, nested, notices)
        if section.choice and isinstance(own.get(section.choice), str):
            current = renamed.current_backend(section.folder, own[section.choice])
            named = f"{where}{section.choice}="
            notices += renamed.compare_names(named + own[section.choice], named + current)
            own[section.choice] = current
        if saved:
            own = _in_range(section.options, own, where, out_of_range)
        found[name] = build(section.options, own, where)
        if saved and section.choice:
            chosen = getattr(found[name], section.choice)
            backends = {backend: lines for backend, lines in backends.items() if chosen in (backend, "auto")}
        elif backends:
            backends = {backend: _checked(name, backend, lines) for backend, lines in backends.items()}
        if backends := {backend: lines for backend, lines in backends.items() if lines}:
            found["backends"][name] = backends
    return Settings(**found, notices=tuple(out_of_range if saved else notices))


def _in_range(options: type[TypedOptions], values: dict[Any, Any], where: str, notices: list[Notice]) -> dict[Any, Any]:
    """The values, with numbers brought into the ranges of their options. notices: receives one for each."""
    types, found = field_types(options), dict(values)
    for key, value in values.items():
        fitting = clamped(types[key], value) if key in types else value
        if fitting != value:
            found[key] = fitting
            said = f"'{where}{key}' of this map was {shown(value)}, which is out of range: {shown(fitting)} is used."
            notices.append(Notice("option-clamped", said))
    return found


def _divided(
    name: str, given: dict[Any, Any], nested: list[str], notices: list[Notice]
) -> tuple[dict[Any, Any], BackendValues]:
    """Separates a section's own options from those of its backends. Raises ConfigError for a key that is neither."""
    section, own, backends = SECTIONS[name], {}, {}
    known = field_types(section.options)
    for key, value in given.items():
        backend = renamed.current_backend(section.folder, key)
        if key in known:
            own[key] = value
        elif section.folder and isinstance(backend, str) and registry.is_backend(section.folder, backend):
            notices += renamed.compare_names(f"{name}.{key}", f"{name}.{backend}")
            where = f"{name}.{backend}"
            backends[backend] = renamed.current_keys(_lines(value, where), f"{where}.", notices)
        else:
            others = registry.backends(section.folder) if section.folder else ()
            raise ConfigError(f"Unknown key '{name}.{shortened(key)}'{nearest(key, [*known, *nested, *others])}.")
    return own, backends


def _checked(section: str, name: str, values: dict[str, Any]) -> dict[str, Any]:
    """The values given for a backend that are not its defaults. Its class checks what their types do not say, if its
    packages are installed. Raises ConfigError."""
    folder, where = SECTIONS[section].folder, f"{section}.{name}."
    backend = registry.backend(folder, name)
    registry.check_names(backend, values, where)
    known = {option.name: option for option in backend.options}
    for key, value in values.items():
        if not isinstance(kind := known[key].kind, str):  # else its module must say what fits
            values = {**values, key: converted(kind, value, f"{where}{key}")}
    values = {key: value for key, value in values.items() if value != known[key].default}
    if not values or backend.missing:
        return values
    options = registry.build_options(registry.load(folder, name), values, where)
    return {key: getattr(options, key) for key in values}


def _section(values: Mapping[Any, Any], name: str) -> dict[Any, Any]:
    given = {} if values.get(name) is None else values[name]
    if not isinstance(given, dict):
        raise ConfigError(f"The section '{name}' must contain 'key: value' lines, got {shown(given)}.")
    return given


def _lines(given: Any, where: str) -> dict[Any, Any]:
    if given is not None and not isinstance(given, dict):
        raise ConfigError(f"'{where}' must contain 'key: value' lines, got {shown(given)}.")
    return given or {}
