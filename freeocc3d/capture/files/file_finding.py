"""Finds the files that a document of a capture names, such as the images of a COLMAP model or of transforms.json.

Documents come from other machines: names have back slashes, another case, a prefix of a folder that is not here, or
the suffix of files that were converted since. Each folder is listed once, so 10,000 names cost no look at each file.
"""

from __future__ import annotations

import difflib
import os
import re
import unicodedata
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from ...core.errors import CaptureError
from ...core.regular_files import MOST_ENTRIES
from ...core.warnings import Notice
from .image_suffixes import COLOR_SUFFIXES

Kind = Literal["color", "depth", "any"]

SUFFIXES = {
    "color": COLOR_SUFFIXES,
    "depth": (".png", ".tif", ".tiff", ".exr", ".npy", ".npz", ".pgm", ".pfm"),
    "any": (),
}
"""Suffixes that a file of a kind may have in place of the stated one."""

_OF_DEPTH = re.compile(r"depth|disp", re.IGNORECASE)
_NO_COLOR = re.compile(r"depth|disp|conf|mask|label|sem|inst|normal|sparse|thumb", re.IGNORECASE)
_DEEPEST = 6
_COMPARED = 1000
_FEWEST = 2


@dataclass
class _Listing:
    """The names in one folder. files, folders: simplified name -> names; by_stem: simplified stem -> names."""

    files: dict[str, list[str]] = field(default_factory=lambda: defaultdict(list))
    folders: dict[str, list[str]] = field(default_factory=lambda: defaultdict(list))
    by_stem: dict[str, list[str]] = field(default_factory=lambda: defaultdict(list))

    def names(self) -> list[str]:
        """The names of all files, sorted."""
        return sorted(name for names in self.files.values() for name in names)


class FileFinder:
    """Finds files below one folder by the names that a document states for them.

    A name is, in this order: the path of a file, as it is; the same with back slashes as slashes; without its first
    folders, as those of another machine; in another case; with another suffix, or one where none is stated. Last, a
    name whose folder is not here is a file anywhere below, if only one has its last part. No name leads outside.
    """

    def __init__(self, folder: Path, kind: Kind = "any"):
        """kind: of the files; it says which suffixes they may have, and which folders the last rule looks into."""
        self.folder, self._kind, self._suffixes = folder, kind, SUFFIXES[kind]
        self._listings: dict[str, _Listing] = {}
        self._anywhere: dict[str, list[str]] | None = None
        self._entries = 0

    def find(self, name: str) -> Path | None:
        """The file of that name, or None. Raises CaptureError if a folder cannot be listed, or holds too much."""
        found = self._exact(name) or self._inexact(name)
        return None if found is None else self.folder / found

    def find_all(self, names: Sequence[str]) -> list[Path | None]:
        """The file of each name, or None. Different names that lead to one file have none, unless one is its path."""
        exact = [self._exact(name) for name in names]
        found = [path or self._inexact(name) for name, path in zip(names, exact, strict=True)]
        named: dict[str, set[str]] = defaultdict(set)
        for name, path in zip(names, found, strict=True):
            if path is not None:
                named[path].add(name)
        own = {path for path in exact if path is not None}
        return [
            self.folder / path if path is not None and (path == stated or (path not in own and len(named[path]) == 1))
            else None
            for path, stated in zip(found, exact, strict=True)
        ]  # fmt: skip

    def nearest(self, name: str) -> str | None:
        """The file that is there and has the most similar name, for messages; None if there is no file."""
        parts = _split(name)
        places = [self._locate(parts[first:-1]) for first in range(len(parts))] if parts else []
        there = next((found for place in places if place is not None and (found := self._list(place).names())), [])
        there = there or sorted({os.path.basename(path) for paths in self._below().values() for path in paths})
        close = difflib.get_close_matches(parts[-1] if parts else name, there[:_COMPARED], 1, 0.0)
        return close[0] if close else None

    def _exact(self, name: str) -> str | None:
        """The path relative to the folder, if ``name`` is the path of a file in it, with or without a suffix."""
        if "\0" in name or os.path.isabs(name):
            return self._below_folder(name)
        path = os.path.normpath(name)
        place, last = os.path.split(path)
        if path.split("/", 1)[0] == ".." or not self._is_folder(place):
            return None
        return path if last in self._list(place).files.get(_simplify(last), ()) else None

    def _below_folder(self, name: str) -> str | None:
        path, base = os.path.normpath(name), os.path.abspath(self.folder)
        inside = "\0" not in name and path.startswith(base + os.sep)
        return self._exact(os.path.relpath(path, base)) if inside else None

    def _inexact(self, name: str) -> str | None:
        parts = _split(name)
        if not parts:
            return None
        for first in range(len(parts)):
            place = self._locate(parts[first:-1])
            found = None if place is None else self._in_folder(place, parts[-1])
            if found is not None or (place and first < len(parts) - 1):
                return found
        return self._by_last_part(parts[-1])

    def _in_folder(self, place: str, last: str) -> str | None:
        """The one file of a folder with that name, in any case, or with that stem and another suffix."""
        listing, simple = self._list(place), _simplify(last)
        names = listing.files.get(simple, [])
        if last in names or len(names) == 1:
            return os.path.join(place, last if last in names else names[0])
        if names:
            return None
        stem = self._stem(simple)
        names = listing.by_stem.get(stem, [])
        if len(names) > 1 and stem == simple:  # no suffix is stated, as in NeRF's synthetic scenes: PNG first
            names = sorted(names, key=lambda name: self._suffixes.index(os.path.splitext(name)[1].lower()))[:1]
        return os.path.join(place, names[0]) if len(names) == 1 else None

    def _by_last_part(self, last: str) -> str | None:
        simple = _simplify(last)
        below = self._below()
        found = below.get(simple) or below.get(f"{self._stem(simple)}.*", [])
        return found[0] if len(found) == 1 else None

    def _stem(self, simple: str) -> str:
        stem, suffix = os.path.splitext(simple)
        return stem if suffix in self._suffixes else simple

    def _locate(self, parts: Sequence[str]) -> str | None:
        """The folder with these parts, in any case, relative to ``folder``; None if there is none, or several."""
        place = ""
        for part in parts:
            names = self._list(place).folders.get(_simplify(part), [])
            if part not in names and len(names) != 1:
                return None
            place = os.path.join(place, part if part in names else names[0])
        return place

    def _is_folder(self, place: str) -> bool:
        parts = place.split("/") if place else []
        return self._locate(parts) == place

    def _below(self) -> dict[str, list[str]]:
        """Relative paths of all files by their simplified name, and by their stem with ``.*``."""
        if self._anywhere is None:
            self._anywhere = defaultdict(list)
            for place in self._walk():
                listing = self._list(place)
                for simple, names in listing.files.items():
                    self._anywhere[simple] += [os.path.join(place, name) for name in names]
                for stem, names in listing.by_stem.items():
                    self._anywhere[f"{stem}.*"] += [os.path.join(place, name) for name in names]
        return self._anywhere

    def _walk(self) -> Iterator[str]:
        """The folders that may hold files of the kind; each once, whatever links lead to it."""
        seen, places = set(), [""] if self.folder.is_dir() else []
        while places:
            place = places.pop(0)
            status = (self.folder / place).stat()
            if (status.st_dev, status.st_ino) in seen:
                continue
            seen.add((status.st_dev, status.st_ino))
            if self._kind != "depth" or not place or _OF_DEPTH.search(place):
                yield place
            if place.count(os.sep) < _DEEPEST:
                names = [name for names in self._list(place).folders.values() for name in names]
                wanted = [name for name in sorted(names) if self._kind != "color" or not _NO_COLOR.search(name)]
                places += [os.path.join(place, name) for name in wanted if not name.startswith(".")]

    def _list(self, place: str) -> _Listing:
        if place not in self._listings:
            listing = self._listings[place] = _Listing()
            try:
                with os.scandir(self.folder / place) as entries:
                    for entry in entries:
                        self._add(listing, entry)
            except FileNotFoundError:
                return listing
            except OSError as error:
                raise CaptureError(f"Cannot read the folder {self.folder / place}: {error.strerror}.") from error
        return self._listings[place]

    def _add(self, listing: _Listing, entry: os.DirEntry[str]) -> None:
        self._entries += 1
        if self._entries > MOST_ENTRIES:
            raise CaptureError(f"{self.folder} holds more than {MOST_ENTRIES:,} files: give the capture's own folder.")
        simple = _simplify(entry.name)
        if _is_folder(entry):
            listing.folders[simple].append(entry.name)
            return
        listing.files[simple].append(entry.name)
        stem, suffix = os.path.splitext(simple)
        if suffix in self._suffixes and not entry.name.startswith("."):
            listing.by_stem[stem].append(entry.name)


def report_missing(
    names: Sequence[str], found: Sequence[Path | None], finder: FileFinder, stated_by: str, what: str = "images"
) -> tuple[Notice, ...]:
    """A warning about the names without a file, which are left out; () if there is none.

    stated_by: what names the files, for messages. Raises CaptureError if fewer than two have a file.
    """
    missing = [name for name, path in zip(names, found, strict=True) if path is None]
    if not missing:
        return ()
    near = finder.nearest(missing[0])
    there = f" (there is {near})" if near else f" ({finder.folder} holds no files)"
    few = len(names) - len(missing)
    folder = finder.folder.name + "/"
    if few < _FEWEST:
        count = "None" if not few else "Only one"
        raise CaptureError(
            f"{count} of the {len(names)} {what} that {stated_by} names is in {folder}: the first that is missing is "
            f"{missing[0]}{there}. Put the {what} there, with these names."
        )
    be = "is" if len(missing) == 1 else "are"
    return (
        Notice(
            "images-left-out",
            f"{len(missing)} of the {len(names)} {what} that {stated_by} names {be} not in {folder} and {be} left out: "
            f"the first is {missing[0]}{there}.",
        ),
    )


def last_part(name: str) -> str:
    """The name of a file without its folders, those of any system."""
    return (_split(name) or [name])[-1]


def _split(name: str) -> list[str]:
    """The parts of a path of any system, without a drive, ``.`` and ``..``."""
    parts = re.split(r"[\\/]+", re.sub(r"^[A-Za-z]:", "", name))
    return [part for part in parts if part not in ("", ".", "..") and "\0" not in part]


def _simplify(name: str) -> str:
    """Equal for names that differ only in case, or in how they write an accent."""
    return name.casefold() if name.isascii() else unicodedata.normalize("NFC", name).casefold()


def _is_folder(entry: os.DirEntry[str]) -> bool:
    try:
        return entry.is_dir()
    except OSError:  # a loop of links
        return False
