"""Tells the format of a capture by its content or, if none fits, says what lies there and what the nearest formats
lack."""

from __future__ import annotations

import fnmatch
import importlib
from collections.abc import Mapping
from pathlib import Path

from ..core.errors import CaptureError
from ..core.regular_files import open_regular
from ..core.warnings import Notice
from ..settings import registry
from .base import Capture
from .files.numbered_files import list_folder
from .files.paired_folders import find_folders
from .folder_contents import ImageFolder, find_image_folders, holds_depth_or_confidence

RECORDINGS = {".mp4", ".m4v", ".mov", ".avi", ".mkv", ".webm", ".r3d", ".sens", ".bag", ".mcap", ".db3"}
"""Suffixes of files that may be a capture."""

_ARCHIVE = "an archive: unpack it, and give the folder"
_FOREIGN = {
    b"PK\x03\x04": _ARCHIVE,
    b"\x1f\x8b": _ARCHIVE,
    b"7z\xbc\xaf": _ARCHIVE,
    b"Rar!": _ARCHIVE,
    b"ply\n": "a mesh or a point cloud, not a scan: give the images that it was made of",
    b"ply\r": "a mesh or a point cloud, not a scan: give the images that it was made of",
    b"\x89PNG": "a single image: give the folder with all images of the scan",
    b"\xff\xd8\xff": "a single image: give the folder with all images of the scan",
}
"""First bytes of files that are no capture -> what they are, and what to do."""

_WANTED = (
    "A capture is a folder with images, such as color/ and depth/ with equal numbers in their names, a recording or a "
    "video; freeocc3d list names all formats."
)

_MOST_BELOW, _NEAREST, _LAST = 1000, 2, 2

Readers = Mapping[str, type[Capture]]


def recognize(path: Path) -> str:
    """Name of the reader that recognizes a folder or file. Formats with a layout of their own come first, then general
    ones with depth, then those of color alone. Raises CaptureError if none recognizes it, or several do."""
    readers = {name: reader for name, reader in list_readers().items() if reader.reads_files or not path.is_file()}
    for rank in range(_LAST + 1):
        found = [name for name, reader in readers.items() if _rank(reader) == rank and reader.recognizes(path)]
        if len(found) > 1:
            raise CaptureError(f"{path} may be of the format {' or '.join(found)}: choose one with capture.format.")
        if found and not (rank == _LAST and (kind := _foreign(path))):
            return found[0]
        if found:
            raise CaptureError(f"{path} is {kind}.")
    raise CaptureError(explain_unknown(path, readers))


def _rank(reader: type[Capture]) -> int:
    return 0 if not reader.general else 1 if reader.has_depth else 2


def _foreign(path: Path) -> str:
    """What a file is that is often mistaken for a recording, with what to do; empty for all others."""
    if not path.is_file():
        return ""
    try:
        with open_regular(path) as stream:
            head = stream.read(8)
    except OSError:
        return ""
    return next((kind for magic, kind in _FOREIGN.items() if head.startswith(magic)), "")


def list_readers() -> dict[str, type[Capture]]:
    """Readers by name, also those of which a package is missing, if they can recognize a capture without it."""
    found = {}
    for name, backend in registry.backends("capture.readers").items():
        try:
            found[name] = importlib.import_module(backend.module).Reader
        except ImportError:
            if not backend.missing:
                raise
    return found


def explain_unknown(path: Path, readers: Readers) -> str:
    """Why a path is no capture of a known format: what lies there, where a capture lies near it, or what the nearest
    formats lack. Never points to a folder of depth or confidence alone."""
    if path.is_file():
        return f"{path} is not a capture of a known format: give a folder of frames, a video, or a recording."
    said = f"{path} is not a capture of a known format"
    if kind := holds_depth_or_confidence(path):
        return f"{said}: it holds {kind} images alone. Give the folder that holds both these and the color images."
    images = find_image_folders(path)
    if near := _near(path, readers, any(folder.kind == "depth" for folder in images)):
        return f"{said}, but {near}."
    if not images:
        return f"{said}: it {_contents(path)}. {_WANTED}"
    return f"{said}. It holds {', '.join(folder.describe(path) for folder in images[:6])}{_reading(path, images)}."


def _near(path: Path, readers: Readers, with_depth: bool) -> str:
    """The subfolder that is a capture, as in data sets of several, or a recording in the folder. with_depth: whether
    there are depth images anywhere, so that none of color alone is meant."""
    names = list_folder(path)[:_MOST_BELOW]
    captures = []
    for child in (path / name for name in names):
        if not child.is_dir() or holds_depth_or_confidence(child) is not None:
            continue
        if any(reader.has_depth and reader.recognizes(child) for reader in readers.values()):
            captures.append(child)
    if captures:
        others = f" (and {len(captures) - 1} more)" if len(captures) > 1 else ""
        return f"{captures[0]} is{others}: give that folder"
    for child in (path / name for name in names):
        if child.suffix.lower() in RECORDINGS and child.is_file():
            return f"{child} may be: give that file"
    color = [child for child in (path / name for name in names) if child.is_dir() and _is_color_alone(child, readers)]
    if color and not with_depth:
        return f"{color[0]} holds images of color alone: give that folder to map it without depth"
    return ""


def _is_color_alone(folder: Path, readers: Readers) -> bool:
    return holds_depth_or_confidence(folder) is None and any(reader.recognizes(folder) for reader in readers.values())


def _reading(path: Path, images: list[ImageFolder]) -> str:
    """A likely reading of the images, and what the nearest formats lack."""
    color, depth = ([folder for folder in images if folder.kind == kind] for kind in ("color", "depth"))
    text = "" if color else ", and no color images: give the folder that holds these, too"
    if color and depth:
        text = (
            f". These are probably the color and the depth of one scan: link them as {path / 'color'} and "
            f"{path / 'depth'}, with the same number in the names of a frame"
        )
    near = sorted(_parts_of(path), key=lambda entry: entry[1], reverse=True)[:_NEAREST]
    lacks = "; ".join(f"{name} lacks {' and '.join(missing)}" for name, share, missing in near if share > 0)
    return f"{text}. The nearest formats: {lacks}" if lacks else text


def _parts_of(path: Path) -> list[tuple[str, float, list[str]]]:
    """Name, share of the parts that are there, and missing parts of every format that states its parts."""
    present = _names(path)
    found = []
    for name, reader in list_readers().items():
        missing = [part for part in reader.parts if not _is_there(part, present)]
        if reader.parts and missing:
            found.append((name, 1 - len(missing) / len(reader.parts), missing))
    return found


def _contents(path: Path) -> str:
    names = list_folder(path)
    if not names:
        return "is empty"
    others = f" and {len(names) - 1:,} other{'s' * (len(names) > 2)}" if len(names) > 1 else ""
    return f"holds {names[0]}{others}, but neither images nor a video"


def _names(path: Path) -> list[str]:
    """Names in the folder and, with the folder before them, in its subfolders."""
    names = []
    for name in list_folder(path)[:_MOST_BELOW]:
        names.append(name)
        names += [f"{name}/{below}" for below in list_folder(path / name)[:_MOST_BELOW]]
    return names


def _is_there(part: str, names: list[str]) -> bool:
    return any(fnmatch.filter(names, pattern.strip()) for pattern in part.split(" or "))


def find_unread_depth(path: Path, name: str) -> list[Notice]:
    """A warning if depth images lie beside the color of a capture that was read without any, as format ``name``."""
    folders = find_folders(path)
    if folders is None:
        return _find_depth_beside(path)
    if holds_depth_or_confidence(folders.depth) != "depth":
        return []
    return [
        Notice(
            "depth-not-read",
            f"{folders.depth} holds {len(folders.depth_names)} depth images, which the format {name} does not name, so "
            "they are not read: set capture.format=image_folders to use them in place of the poses that it states.",
        )
    ]


def _find_depth_beside(path: Path) -> list[Notice]:
    """A warning if ``path`` is the color folder of a capture with depth."""
    folder = path.absolute()
    try:
        folders = find_folders(folder.parent)
    except CaptureError:  # of another user
        return []
    if folders is None or folders.color != folder or holds_depth_or_confidence(folders.depth) != "depth":
        return []
    return [
        Notice(
            "depth-not-read",
            f"{folders.depth} holds {len(folders.depth_names)} depth images, and {path} has the color alone: give "
            f"{folder.parent} to use both.",
        )
    ]
