"""Lists the files of a folder that have frame numbers in their names."""

from __future__ import annotations

import re
from pathlib import Path

from ...core.errors import CaptureError
from ...core.regular_files import list_names


def list_numbered(folder: Path, pattern: str) -> dict[int, Path]:
    """The files of ``folder`` with names that fully match ``pattern``, keyed by the number in its first group.

    Raises CaptureError if two files have the same number, or the folder cannot be read.
    """
    expression, found = re.compile(pattern, re.IGNORECASE), dict[int, Path]()
    for name in list_folder(folder):
        if match := expression.fullmatch(name):
            path = folder / name
            other = found.setdefault(int(match[1]), path)
            if other is not path:
                raise CaptureError(
                    f"{folder} holds two files of frame {int(match[1])}, {other.name} and {name}: remove one."
                )
    return found


def list_folder(folder: Path) -> list[str]:
    """The names in ``folder``, sorted; empty if there is no such folder. Raises CaptureError if it cannot be read, or
    holds too much."""
    try:
        return list_names(folder) if folder.is_dir() else []
    except OSError as error:
        raise CaptureError(f"Cannot read the folder {folder}: {error.strerror}.") from error


def has_file(folder: Path, pattern: str) -> bool:
    """Whether ``folder`` holds a file with a name that fully matches ``pattern``."""
    expression = re.compile(pattern, re.IGNORECASE)
    return any(map(expression.fullmatch, list_folder(folder)))
