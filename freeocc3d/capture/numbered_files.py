"""Lists the files of a folder that have frame numbers in their names."""

from __future__ import annotations

import re
from pathlib import Path

from ..core.errors import CaptureError


def list_numbered(folder: Path, pattern: str) -> dict[int, Path]:
    """The files of ``folder`` with names that fully match ``pattern``, keyed by the number in its first group.

    Raises CaptureError if two files have the same number.
    """
    expression, found = re.compile(pattern, re.IGNORECASE), dict[int, Path]()
    for path in sorted(folder.iterdir()) if folder.is_dir() else ():
        if match := expression.fullmatch(path.name):
            other = found.setdefault(int(match[1]), path)
            if other is not path:
                raise CaptureError(
                    f"{folder} holds two files of frame {int(match[1])}, {other.name} and {path.name}: remove one."
                )
    return found


def has_file(folder: Path, pattern: str) -> bool:
    """Whether ``folder`` holds a file with a name that fully matches ``pattern``."""
    expression = re.compile(pattern, re.IGNORECASE)
    return folder.is_dir() and any(expression.fullmatch(path.name) for path in folder.iterdir())
