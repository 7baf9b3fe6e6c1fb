"""The options of a layer and the backends that a configuration names."""

from __future__ import annotations

from typing import Any

from ..settings import config, registry
from ..settings.config import Config


def load_backend(settings: Config, section: str, key: str, *arguments: Any) -> Any:
    """The backend that ``settings[section][key]`` names, made with its own options and what else its kind takes."""
    name = settings[section][key]
    folder = config.SECTIONS[section][1]
    assert folder is not None
    module = registry.load(folder, name)
    if not hasattr(module, "Options"):
        return module.load(*arguments)
    return module.load(registry.build_options(module, settings[section].get(name, {})), *arguments)


def options_of(module: Any, values: dict[str, Any]) -> Any:
    return registry.build_options(module, values)
