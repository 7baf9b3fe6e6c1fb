"""Finds folders for compiled kernels: those of an installation may be read-only, and a service may have no home.

Files of these folders are code. So a folder that others may write is used only if the user named it.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import os
import stat
import tempfile
from collections.abc import Iterator
from pathlib import Path


@functools.cache
def find_writable_folder(source: Path) -> Path | None:
    """The first folder that can be written, for the kernels of the Python files in the folder ``source``: in
    ``$NUMBA_CACHE_DIR``, ``__pycache__`` beside them, in the user's cache (``$XDG_CACHE_HOME`` or ``~/.cache``), in a
    folder of this user alone among the temporary files; None if there is none."""
    for folder in _candidates(source):
        with contextlib.suppress(OSError):
            folder.mkdir(parents=True, exist_ok=True)
            tempfile.TemporaryFile(dir=folder).close()
            return folder
    return None


def _candidates(source: Path) -> Iterator[Path]:
    name = f"{source.name}_{hashlib.sha1(os.fsencode(source), usedforsecurity=False).hexdigest()}"
    if named := os.environ.get("NUMBA_CACHE_DIR"):
        yield Path(named, name)
    yield source / "__pycache__"
    home = os.environ.get("HOME", "")
    for caches in (Path(os.environ.get("XDG_CACHE_HOME", "")), Path(home, ".cache")):
        if caches.is_absolute() and _is_private(caches / "freeocc3d"):
            yield caches / "freeocc3d" / name
    with contextlib.suppress(OSError):  # no folder for temporary files
        private = Path(tempfile.gettempdir(), f"freeocc3d-{os.getuid()}")
        if _is_private(private):
            yield private / name


def _is_private(folder: Path) -> bool:
    """Makes the folder. Whether it is a folder of this user that nobody else can write."""
    with contextlib.suppress(OSError):
        folder.parent.mkdir(parents=True, exist_ok=True)
        with contextlib.suppress(FileExistsError):
            folder.mkdir(mode=0o700)
        found = folder.lstat()
        return stat.S_ISDIR(found.st_mode) and found.st_uid == os.getuid() and not found.st_mode & 0o022
    return False
