"""The files of a saved map: none is read that is not regular, or has another size or checksum than the manifest
states."""

from __future__ import annotations

import os
import stat
from pathlib import Path

from ..core.checksums import hash_file
from ..core.errors import MapError
from ..core.regular_files import check_regular
from .manifest import Manifest
from .map_files import ALWAYS, KEYFRAMES, MANIFEST


class CheckedFiles:
    """The files that a manifest lists, in a map folder."""

    def __init__(self, folder: Path, manifest: Manifest):
        self._folder = folder
        self._sizes = manifest.files
        self._checksums = manifest.checksums or {}
        self._checked: set[str] = set()

    def check_sizes(self) -> None:
        """Check that every file exists, lies in the folder, is regular, and has its size, and that a map's files are
        listed. Raises MapError. Reads no file."""
        lacking = [name for name in ALWAYS if name not in self._sizes]
        if self._checksums:
            lacking += self._sizes.keys() ^ self._checksums.keys()
        if lacking:
            raise MapError(f"{self._folder / MANIFEST} is damaged: 'files' or 'checksums' lacks {lacking[0]!r}.")
        if (self._folder / KEYFRAMES).is_symlink():
            self._inside(KEYFRAMES)
        for name in self._sizes:
            self._check_size(name)

    def path(self, name: str) -> Path:
        """The path of a listed file, whose checksum is compared the first time. Raises MapError."""
        path = self._folder / name
        if name not in self._checked:
            if name not in self._sizes:
                raise MapError(f"{path} is not a file of the map: {MANIFEST} does not list it.")
            self._check_size(name)
            try:
                stated = self._checksums.get(name)
                if stated is not None and hash_file(path) != stated:
                    raise MapError(
                        f"{path} is damaged: its checksum differs from the one in {MANIFEST}. Copy the whole folder "
                        "again, or map again."
                    )
            except OSError as error:
                raise MapError(f"Cannot read {path}: {error.strerror}.") from error
            self._checked.add(name)
        return path

    def _check_size(self, name: str) -> None:
        path = self._folder / name
        try:
            found = path.lstat()
            if not stat.S_ISREG(found.st_mode):
                self._inside(name)
                found = check_regular(path)
        except FileNotFoundError as error:
            raise MapError(
                f"The map {self._folder} lacks its file {name}: copy the whole folder, or map again."
            ) from error
        except OSError as error:
            raise MapError(f"{path} cannot be read: {error.strerror}.") from error
        if found.st_size != self._sizes[name]:
            raise MapError(f"{path} is damaged: it has {found.st_size} bytes instead of {self._sizes[name]}.")

    def _inside(self, name: str) -> None:
        """Raise MapError for a link that leads out of the folder."""
        root, target = os.path.realpath(self._folder), os.path.realpath(self._folder / name)
        if not target.startswith(root + os.sep):
            raise MapError(f"{self._folder / name} lies outside the map's folder: it is a link to {target}.")
