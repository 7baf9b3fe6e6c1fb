"""Renamed options and backends. Old names work for one release and give a warning; in saved maps they stay valid."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from typing import Any

from ..core.errors import ConfigError

OPTIONS: dict[str, str] = {
    "gaussians.initialisation": "initialization",
    "tracking.rgbd.neighbours": "neighbors",
    "tracking.stereo.neighbours": "neighbors",
}
"""Section (and backend) and old key -> new key."""

REMOVED = {"fitting.window", "fitting.window_passes"}
"""Options that had no effect; they are dropped."""

BACKENDS: dict[str, dict[str, str]] = {"language.encoders": {"colour": "color"}}
"""Folder of backends -> old name -> new name."""


class RenamedWarning(FutureWarning):
    """An option or a backend has an old name that a later release will refuse."""


def current_backend(folder: str, name: str) -> str:
    """The current name of a backend."""
    return BACKENDS.get(folder, {}).get(name, name)


def current_keys(values: Mapping[Any, Any], where: str, warn: bool = True) -> dict[Any, Any]:
    """Returns ``values`` under the current keys. where: the text before them in a configuration, such as "gaussians.".

    Raises ConfigError if an option is given under both names.
    """
    found = {}
    for key, value in values.items():
        if f"{where}{key}" in REMOVED:
            if warn:
                warnings.warn(
                    f"'{where}{key}' has no effect: remove it. A later release will refuse it.", RenamedWarning, 2
                )
            continue
        new = OPTIONS.get(f"{where}{key}", key)
        if new != key and new in values:
            raise ConfigError(f"'{where}{key}' is the old name of '{where}{new}': give only the new one.")
        if warn:
            warn_if_renamed(f"{where}{key}", f"{where}{new}")
        found[new] = value
    return found


def warn_if_renamed(old: str, new: str) -> None:
    """Warns if a name changed."""
    if old != new:
        warnings.warn(f"'{old}' is now called '{new}': a later release will refuse the old name.", RenamedWarning, 2)
