"""Files of class names, and of what the names of one taxonomy are called in another."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from ..core.errors import CaptureError, ConfigError
from ..settings.registry import nearest

_MOST_CLASSES = 65536


def read_names(path: Path) -> tuple[str, ...]:
    """Names in a JSON document {"classes": [...]} or a list, or one a line, in the order of their numbers.

    Raises CaptureError: no such file, not of this form.
    """
    try:
        text = path.read_text(encoding="utf-8")
        names = json.loads(text) if path.suffix == ".json" else [line for line in text.splitlines() if line.strip()]
        names = names["classes"] if isinstance(names, dict) else names
    except OSError as error:
        raise CaptureError(f"Cannot read the class names in {path}: {error.strerror}.") from error
    except (ValueError, KeyError, RecursionError) as error:
        raise CaptureError(f'{path} must hold {{"classes": ["nothing", "name of class 1", …]}}: {error}.') from error
    if (
        not isinstance(names, list)
        or not 2 <= len(names) <= _MOST_CLASSES
        or not all(isinstance(n, str) for n in names)
    ):
        raise CaptureError(f"{path} must name at least 2 classes.")
    return tuple(name.strip() for name in names)


def read_mapping(path: Path, names: tuple[str, ...]) -> tuple[tuple[str, ...], NDArray[np.float32]]:
    """What classes become in another taxonomy: its T names, and (T, C) 1 where class c counts as the t-th of them.

    The file is one of ``freeocc3d evaluate --classes``: ``classes: [wall, …]`` and ``map: {name: class or null}``. A
    class that it does not name must have the name of one of its classes; null leaves a class out. Raises ConfigError.
    """
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(f"Cannot read the mapping of classes {path}: {error.strerror}.") from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ConfigError(
            f"The mapping of classes {path} is not valid YAML: {' '.join(str(error).split())}."
        ) from error
    targets, becomes = _checked(content, path)
    row = {target.lower(): t for t, target in enumerate(targets)}
    matrix = np.zeros((len(targets), len(names)), np.float32)
    for c, name in enumerate(names):
        target = becomes.get(name.lower(), name)
        if target is None:
            continue
        if target.lower() not in row:
            raise ConfigError(
                f"{path} does not say what '{name}' becomes{nearest(name, becomes)}: add it to 'map', with one of the "
                "classes or null."
            )
        matrix[row[target.lower()], c] = 1.0
    return targets, matrix


def _checked(content: Any, path: Path) -> tuple[tuple[str, ...], dict[str, str | None]]:
    content = content if isinstance(content, dict) else {}
    classes, mapped = content.get("classes") or [], content.get("map") or {}
    if not isinstance(classes, list) or not isinstance(mapped, dict) or not _are_names(classes):
        raise ConfigError(f"{path} must hold 'classes', a list of names, and 'map', lines that read 'name: class'.")
    targets = tuple(name.strip() for name in classes)
    becomes = {str(name).strip().lower(): None if to is None else str(to).strip() for name, to in mapped.items()}
    known = {target.lower() for target in targets}
    if strange := [(name, to) for name, to in becomes.items() if to is not None and to.lower() not in known]:
        raise ConfigError(f"{path} maps '{strange[0][0]}' to '{strange[0][1]}', which is none of its classes.")
    return targets, becomes


def _are_names(values: list[Any]) -> bool:
    return len(values) > 0 and all(isinstance(value, str) for value in values)
