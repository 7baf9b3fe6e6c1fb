"""Reads files of class names, and of maps from the names of one taxonomy to those of another.

    classes: [ceiling, floor, wall]     # in the order of their numbers
    map:                                # optional: other name -> one of these classes, or null for none
      carpet: floor
      ceiling lamp: null

The file is YAML or JSON, or a bare list of names: YAML, JSON, or one name per line. Case does not matter.
"""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.errors import CaptureError, ConfigError
from ..core.regular_files import read_text
from ..core.typed_documents import InvalidDocument, parse_json
from ..core.yaml_documents import parse_yaml
from ..settings.presets import find_preset
from ..settings.registry import nearest

CLASSES_JSON = "classes.json"
"""The file in a capture's folder that names the values of its class images."""

_MOST_BYTES = 4 << 20
_LONGEST_NAME = 1000
_NOT_TEXT = re.compile("[\x00-\x08\x0a-\x1f\x7f\ud800-\udfff]")
_MOST_CLASSES = 4096
_MOST_IN_BYTES = 255
"""Largest number of classes: the class images of a capture are uint8."""


@dataclass(frozen=True)
class ClassFile:
    """The content of a class file.

    names: class names in order.  targets: other name, in lower case -> one of ``names``; None = none of them.
    """

    path: Path
    names: tuple[str, ...]
    targets: dict[str, str | None]

    def grouping(self, names: Sequence[str]) -> NDArray[np.float32]:
        """(T, C) matrix: 1 where class c of ``names`` counts as class t of the file. A class that is not in ``targets``
        must have the name of a class of the file. Raises ConfigError."""
        row = {name.lower(): t for t, name in enumerate(self.names)}
        matrix = np.zeros((len(self.names), len(names)), np.float32)
        for c, name in enumerate(names):
            target = self.targets.get(name.lower(), name)
            if target is None:
                continue
            if target.lower() not in row:
                raise ConfigError(
                    f"{self.path} does not say what '{name}' becomes{nearest(name, self.targets)}: add it to 'map', "
                    "with one of the classes or null."
                )
            matrix[row[target.lower()], c] = 1.0
        return matrix


def read_class_file(path: Path) -> ClassFile:
    """Read a class file, or a preset by its name, such as ``nyu40_to_embodiedocc``.

    Raises ConfigError for an unknown preset, CaptureError for a file that is missing, has another form, or maps a name
    to an unknown class.
    """
    path = find_preset(path, "classes")
    content = _content(path)
    if isinstance(content, list):
        content = {"classes": content}
    if not isinstance(content, dict) or "classes" not in content:
        raise CaptureError(f"The class file {path} must hold 'classes', a list of names, and may hold 'map'.")
    if path.suffix != ".json" and (strange := set(content) - {"classes", "map"}):
        raise CaptureError(
            f"The class file {path} must hold 'classes', a list of names, and may hold 'map', but not "
            f"'{str(min(strange, key=str))[:100]}'."
        )
    classes, mapped = content["classes"], content.get("map") or {}
    if not isinstance(classes, list) or not classes or not all(isinstance(name, str) for name in classes):
        raise CaptureError(f"'classes' of {path} must hold a list of names (quote a name like \"no\").")
    if not all(len(name) <= _LONGEST_NAME and not _NOT_TEXT.search(name) for name in classes):
        raise CaptureError(f"'classes' of {path} holds a name that is longer than {_LONGEST_NAME} letters or not text.")
    if len(classes) > _MOST_CLASSES:
        raise CaptureError(f"{path} names {len(classes)} classes, but at most {_MOST_CLASSES} are possible.")
    if not isinstance(mapped, dict) or not all(
        isinstance(name, str) and isinstance(target, str | None) for name, target in mapped.items()
    ):
        raise CaptureError(f"'map' of {path} must hold lines of the form 'name: class'.")
    names = tuple(name.strip() for name in classes)
    spelled = {name.lower(): name for name in names}
    targets: dict[str, str | None] = {}
    for name, target in mapped.items():
        if target is not None and target.strip().lower() not in spelled:
            raise CaptureError(
                f"{path} maps '{name[:100]}' to '{target[:100]}', which is not one of its classes: correct it."
            )
        targets[name.strip().lower()] = None if target is None else spelled[target.strip().lower()]
    return ClassFile(path, names, targets)


def read_class_names(path: Path) -> tuple[str, ...]:
    """Read the names of a class file: at least two, "nothing" and a class. Raises CaptureError."""
    names = read_class_file(path).names
    if len(names) < 2:
        raise CaptureError(f"{path} must name at least 2 classes, the first for nothing.")
    return names


def capture_class_names(folder: Path) -> tuple[str, ...]:
    """The names in ``classes.json`` of a capture's folder, the first one for nothing; empty if the file is missing.
    Raises CaptureError."""
    path = folder / CLASSES_JSON
    names = read_class_file(path).names if os.path.lexists(path) else ()
    if len(names) > _MOST_IN_BYTES:
        raise CaptureError(f"{path} must hold at most {_MOST_IN_BYTES} classes, because class images are 8-bit.")
    return names


def _content(path: Path) -> Any:
    """The content of the file, as plain data."""
    form = "JSON" if path.suffix == ".json" else "YAML" if path.suffix in (".yaml", ".yml") else "text"
    try:
        text = read_text(path, _MOST_BYTES)
        if form == "JSON":
            return parse_json(text, finite=True)
        return parse_yaml(text) if form == "YAML" else [line for line in text.splitlines() if line.strip()]
    except OSError as error:
        raise CaptureError(f"Cannot read the class file {path}: {(error.strerror or str(error)).lower()}.") from error
    except (InvalidDocument, UnicodeDecodeError) as error:
        raise CaptureError(
            f"The class file {path} is not valid {form}: {error}. It must hold 'classes', a list of names."
        ) from error
