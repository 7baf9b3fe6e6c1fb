"""The folder that a run is asked to write."""

from __future__ import annotations

from pathlib import Path

from ..core.errors import MapError
from . import map_files


def follow_link(output: Path) -> Path:
    """The folder to which an output that is a link leads. Raises MapError for links in a circle."""
    if not output.is_symlink():
        return output
    try:
        return output.resolve(strict=False)
    except (OSError, RuntimeError) as error:
        raise MapError(f"{output} is a link that leads nowhere: choose another folder.") from error


def refuse_output(output: Path, overwrite: bool) -> None:
    """Raise MapError if a folder of that name must not become a map."""
    if output.exists() and not overwrite:
        raise MapError(f"{output} exists: choose another folder, or replace it with --overwrite.")
    if output.exists() and not (output / map_files.MANIFEST).is_file():
        raise MapError(f"{output} is not a map, so it is not overwritten: choose another folder.")
