"""The one rule for names of exported files: an ending is one of those that programs expect of the format.

An exporter states them as ``ENDINGS``; "" is the name of a folder. One without takes any name.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ..core.errors import ConfigError
from ..settings import registry


def check_name(format_name: str, path: Path) -> None:
    """Raise ConfigError if the file's ending is not one of the format, with those of the format, and with the format
    that has this ending, if any. Raises ConfigError and DependencyError for an exporter that cannot be loaded."""
    endings = _endings(format_name)
    if endings:
        others = [name for name in registry.backends("export") if name != format_name]
        check_ending(
            path,
            endings,
            format_name,
            [name for name in others if path.suffix and path.suffix.lower() in _stated(name)],
        )


def check_ending(path: Path, endings: Sequence[str], format_name: str, others: Sequence[str] = ()) -> None:
    """Raise ConfigError if ``path`` has none of the endings. others: formats that have its ending."""
    if path.suffix.lower() not in endings:
        instead = f"; {path.suffix} is of the format {' or '.join(others)}" if others else ""
        raise ConfigError(
            f"The name of a file of the format {format_name} must end in {_listed(endings)}, got '{path.name}'"
            f"{instead}."
        )


def _listed(endings: Sequence[str]) -> str:
    return " or ".join(ending or "nothing, for a folder" for ending in endings)


def _endings(format_name: str) -> tuple[str, ...]:
    return tuple(getattr(registry.load("export", format_name), "ENDINGS", ()))


def _stated(format_name: str) -> tuple[str, ...]:
    """The endings of another format; none if it needs a package that is missing."""
    return () if registry.backends("export")[format_name].missing else _endings(format_name)
