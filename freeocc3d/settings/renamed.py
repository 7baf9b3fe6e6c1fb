"""Renamed options and backends. Old names work for one release and give a warning; in saved maps they stay valid."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ..core.errors import ConfigError
from ..core.warnings import Notice
from .option_types import shown

OPTIONS: dict[str, str] = {
    "gaussians.initialisation": "initialization",
    "tracking.rgbd.neighbours": "neighbors",
    "tracking.stereo.neighbours": "neighbors",
}
"""Section (and backend) and old key -> new key."""

REMOVED = {"carving.noise", "fitting.window", "fitting.window_passes"}
"""Options that have no effect any more; they are dropped."""

BACKENDS: dict[str, dict[str, str]] = {"language.encoders": {"colour": "color"}}
"""Folder of backends -> old name -> new name."""


def current_backend(folder: str, name: str) -> str:
    """The current name of a backend."""
    return BACKENDS.get(folder, {}).get(name, name)


def current_keys(values: Mapping[Any, Any], where: str, notices: list[Notice]) -> dict[Any, Any]:
    """Returns ``values`` under the current keys. where: the text before them in a configuration, such as "gaussians.".
    notices: receives one for each old name.

    Raises ConfigError if an option is given under both names.
    """
    found = {}
    for key, value in values.items():
        old = f"{where}{key if isinstance(key, str) else shown(key)}"
        if old in REMOVED:
            notices.append(
                Notice("option-removed", f"'{old}' has no effect: remove it. A later release will refuse it.")
            )
            continue
        new = OPTIONS.get(old, key)
        if new != key and new in values:
            raise ConfigError(f"'{old}' is the old name of '{where}{new}': give only the new one.")
        found[new] = value
        if new != key:
            notices += compare_names(old, f"{where}{new}")
    return found


def compare_names(old: str, new: str) -> list[Notice]:
    """Returns the warning if a name changed."""
    text = f"'{old}' is now called '{new}': a later release will refuse the old name."
    return [Notice("option-renamed", text)] if old != new else []
