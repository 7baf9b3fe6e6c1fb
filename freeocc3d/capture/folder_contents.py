"""What the images of a folder are: color, depth or confidence, told by the head of one file of each folder."""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from ..core.errors import FrameError
from ..core.image_files import PNG_START, Size
from ..core.regular_files import IMAGE_BYTES, open_regular
from .files.image_suffixes import COLOR_SUFFIXES, DEPTH_SUFFIXES, HEIF_SUFFIXES
from .files.numbered_files import list_folder
from .images.image_decoding import image_size

Kind = Literal["color", "depth", "confidence"]

_SUFFIXES = (*COLOR_SUFFIXES, *HEIF_SUFFIXES, *DEPTH_SUFFIXES)
_DEPTH_ALONE = DEPTH_SUFFIXES - set(COLOR_SUFFIXES)

_CONFIDENCE = re.compile(r"conf", re.IGNORECASE)
_DEPTH = re.compile(r"depth|disp", re.IGNORECASE)
_MOST_FOLDERS = 200
_FEWEST = 2


@dataclass(frozen=True)
class ImageFolder:
    """A folder of images of one kind. count: how many.  suffix: the most common.  size: of the first, if it can be
    read."""

    path: Path
    kind: Kind
    count: int
    suffix: str
    size: Size | None

    def describe(self, root: Path) -> str:
        """Words such as "depth in d/ (240 .png of 640 x 480)"."""
        place = "the folder itself" if self.path == root else f"{self.path.relative_to(root)}/"
        size = "" if self.size is None else f" of {self.size[0]} x {self.size[1]}"
        return f"{self.kind} in {place} ({self.count} {self.suffix}{size})"


def find_image_folders(root: Path, levels: int = 2) -> list[ImageFolder]:
    """The folders of images in ``root`` and up to so many levels below it. Looks at names and at the head of a file in
    each. Raises CaptureError if a folder cannot be listed."""
    found: list[ImageFolder] = []
    waiting, seen = [(root, levels)], 0
    while waiting and seen < _MOST_FOLDERS:
        folder, left = waiting.pop(0)
        seen += 1
        names = [name for name in list_folder(folder) if not name.startswith(".")]
        found += _describe(folder, names)
        if left:
            below = [folder / name for name in names[: 10 * _MOST_FOLDERS] if not Path(name).suffix]
            waiting += [(child, left - 1) for child in below if child.is_dir() and not child.is_symlink()]
    return found


def holds_depth_or_confidence(folder: Path) -> Kind | None:
    """ "depth" or "confidence" if the images of a folder are that and no color; else None."""
    names = [name for name in list_folder(folder) if not name.startswith(".")]
    kinds = {found.kind for found in _describe(folder, names)}
    return None if "color" in kinds or not kinds else min(kinds, key=("depth", "confidence", "color").index)


def _describe(folder: Path, names: list[str]) -> list[ImageFolder]:
    """The images of one folder, by kind: files with "depth" in their names are apart from the others."""
    groups: dict[bool, list[str]] = {}
    for name in names:
        if name.lower().endswith(_SUFFIXES):
            groups.setdefault(bool(_DEPTH.search(name)), []).append(name)
    return [_group(folder, group) for group in groups.values() if len(group) >= _FEWEST]


def _group(folder: Path, names: list[str]) -> ImageFolder:
    suffix = Counter(Path(name).suffix.lower() for name in names).most_common(1)[0][0]
    first = folder / next(name for name in names if name.lower().endswith(suffix))
    try:
        size = image_size(first) if suffix in COLOR_SUFFIXES else None
    except FrameError:
        size = None
    return ImageFolder(folder, _kind(first), len(names), suffix, size)


def _kind(file: Path) -> Kind:
    if file.suffix.lower() in _DEPTH_ALONE:
        return "depth"
    try:
        with open_regular(file, IMAGE_BYTES) as stream:
            head = stream.read(26)
    except OSError:
        head = b""
    gray = head.startswith(PNG_START) and head[25:26] == b"\x00"
    if gray and head[24:25] == b"\x10":
        return "depth"
    if gray and (_CONFIDENCE.search(file.name) or _CONFIDENCE.search(file.parent.name)):
        return "confidence"
    of_depth = _DEPTH.search(file.parent.name) or _DEPTH.search(file.name)
    return "depth" if of_depth and (gray or file.suffix.lower() in (".tif", ".tiff")) else "color"
