"""Finds color and depth images that lie in two folders, or in one, under any of their usual names."""

from __future__ import annotations

import heapq
import re
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

from ...core.errors import CaptureError
from ...core.warnings import Notice
from .image_suffixes import COLOR_SUFFIXES, DEPTH_SUFFIXES
from .name_matching import FEWEST_PAIRED, match_names, order_names
from .numbered_files import list_folder

_KIND = r"(?:rgb|colou?r|image|img|frame|left|picture|photo)s?"
_MADE = r"(?:aligned|undistorted|undist|rectified|rect|resized|raw|registered|camera|cam|kinect|realsense|main)"
_LIKELY = re.compile(r"(?i:rgb|colou?r|ima?g|frame|left|picture|photo|depth|conf|pose)")
_COLOR = re.compile(rf"{_MADE}?{_KIND}{_MADE}?(?:{_KIND})?{_MADE}?\d?")
_DEPTH = re.compile(r"depth")
_NO_DEPTH = re.compile(
    r"vis|colou?red|colou?rmap|conf|mask|preview|edge|normal|thumb|info|intrin|calib|std|var|uncert|sem|label|heat"
)
_CONFIDENCE = re.compile(r"(?:depth)?conf(?:idence)?s?(?:maps?|images?|imgs?|depth)?")
_POSES = re.compile(r"(?:camera|cam|gt)?poses?")
_NO_COLOR = re.compile(r"depth|disp|conf|mask|label|sem|inst|normal|thumb|_ir\b|infra")
_ENDINGS = (*COLOR_SUFFIXES, *DEPTH_SUFFIXES)
_MOST_FOLDERS = 50
_FIRST_COLOR = ("rgb", "color", "colour")
_FIRST_DEPTH = ("depth", "depths")
_REGISTERED = re.compile(r"align|regist|tocolou?r|torgb|undist|rect")


@dataclass(frozen=True)
class PairedFolders:
    """Where color and depth lie, and their file names, sorted. The two folders may be one. confidence: folder of
    confidence images.  poses: folder of a pose file per frame."""

    color: Path
    color_names: tuple[str, ...]
    depth: Path
    depth_names: tuple[str, ...]
    confidence: Path | None = None
    poses: Path | None = None


@dataclass(frozen=True)
class ImagePair:
    """The files of one frame. time: seconds.  number: of the frame in its name, None without.  row: place of the color
    file among all color files in their order."""

    color: Path
    depth: Path | None
    time: float
    number: int | None = None
    row: int = 0
    confidence: Path | None = None


@dataclass(frozen=True)
class PairList:
    """The frames of a capture in order. has_times: whether names or lists state times.  colors: how many color files
    there are.  notices: about files without a partner."""

    pairs: tuple[ImagePair, ...]
    has_times: bool
    colors: int
    notices: tuple[Notice, ...] = field(default=())


def find_folders(path: Path) -> PairedFolders | None:
    """The color and depth images of ``path``; None if it has not both. Looks at names only."""
    names = [name for name in list_folder(path) if not name.startswith(".")]
    folders = {name: _simplify(name) for name in names if _LIKELY.search(name)}
    color = _best(path, [name for name, simple in folders.items() if _COLOR.fullmatch(simple)], _FIRST_COLOR)
    depth_like = [name for name, simple in folders.items() if _DEPTH.search(simple) and not _NO_DEPTH.search(simple)]
    depth = _best(path, depth_like, _FIRST_DEPTH, DEPTH_SUFFIXES)
    color_here, depth_here = _split(names)
    color = color or (path, color_here)
    depth = depth or (path, depth_here)
    if not color[1] or not depth[1]:
        return None
    beside = [_best(path, [n for n, simple in folders.items() if kind.fullmatch(simple)], (), suffixes)
              for kind, suffixes in ((_CONFIDENCE, {".png"}), (_POSES, {".txt"}))]  # fmt: skip
    confidence, poses = (found[0] if found else None for found in beside)
    return PairedFolders(*color, *depth, confidence, poses)


def list_images(folder: Path, suffixes: Iterable[str] = COLOR_SUFFIXES) -> tuple[str, ...]:
    """The names of the files with these suffixes, in any case; without hidden files. Raises CaptureError if the folder
    cannot be listed."""
    endings = tuple(suffixes)
    return tuple(name for name in list_folder(folder) if name.lower().endswith(endings) and name[0] != ".")


def pair_images(folders: PairedFolders, path: Path, with_depth: bool) -> PairList:
    """The frames of two folders, paired by the numbers or times in their names.

    Raises CaptureError if fewer than half of the images of the smaller folder have a partner.
    """
    color, depth = folders.color_names, folders.depth_names
    order = order_names(color)
    places = {row: place for place, row in enumerate(order.first)}
    found = match_names(color, depth) if with_depth else order
    if len(found.first) < FEWEST_PAIRED * (min(len(color), len(depth)) if with_depth else len(color)):
        raise CaptureError(_no_pairs(folders, path, len(found.first)))
    confidence = _confidence(folders)
    pairs = [
        ImagePair(
            folders.color / color[row],
            folders.depth / depth[other] if with_depth else None,
            float(place if found.times is None else found.times[place]),
            found.numbers[place] if found.numbers else None,
            places.get(row, row),
            confidence.get(row),
        )
        for place, (row, other) in enumerate(zip(found.first, found.second, strict=True))
    ]
    notices = _alone(folders, path, set(found.first), set(found.second), found.tolerance_s) if with_depth else ()
    return PairList(tuple(pairs), found.times is not None, len(color), notices)


def _simplify(name: str) -> str:
    return re.sub(r"[\W_]+", "", name.casefold())


def _best(
    path: Path, names: list[str], first: tuple[str, ...], suffixes: Iterable[str] = COLOR_SUFFIXES
) -> tuple[Path, tuple[str, ...]] | None:
    """The folder with the most usual of these names that holds files with the suffixes, and their names."""
    suffixes = tuple(suffixes)

    def rank(name: str) -> tuple[bool, int, int, str]:
        simple = _simplify(name)
        usual = first.index(simple) if simple in first else len(first)
        return not (first and _REGISTERED.search(simple)), usual, len(name), name

    for name in heapq.nsmallest(_MOST_FOLDERS, names, key=rank):
        if found := list_images(path / name, suffixes):
            return path / name, found
    return None


def _split(names: Iterable[str]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """The color and the depth images among files of one folder."""
    color, depth = list[str](), list[str]()
    for name in names:
        lower = name.lower()
        if not lower.endswith(_ENDINGS):
            continue
        stem = lower.rpartition(".")[0]
        if lower.endswith(tuple(DEPTH_SUFFIXES)) and _DEPTH.search(stem) and not _NO_DEPTH.search(stem):
            depth.append(name)
        elif lower.endswith(COLOR_SUFFIXES) and not _NO_COLOR.search(stem):
            color.append(name)
    return tuple(color), tuple(depth)


def _confidence(folders: PairedFolders) -> dict[int, Path]:
    """Row of the color name -> its confidence image."""
    if folders.confidence is None:
        return {}
    names = list_images(folders.confidence, {".png"})
    found = match_names(folders.color_names, names, by_time=False)
    return {row: folders.confidence / names[other] for row, other in zip(found.first, found.second, strict=True)}


def _no_pairs(folders: PairedFolders, path: Path, found: int) -> str:
    color, depth = folders.color_names, folders.depth_names
    for folder, names in ((folders.color, color), (folders.depth, depth)):
        stem, count = Counter(Path(name).stem.lower() for name in names).most_common(1)[0]
        if count > 1:
            two = [name for name in names if Path(name).stem.lower() == stem]
            return f"{folder} holds two images of frame {stem}, {two[0]} and {two[1]}: remove one kind."
    return (
        f"The names of the {len(color)} color images (first {folders.color.name}/{color[0]}) and of the {len(depth)} "
        f"depth images (first {folders.depth.name}/{depth[0]}) of {path} do not match: {found or 'no'} "
        f"{'pair has' if found == 1 else 'pairs have'} equal numbers, or times that differ by less than half a frame "
        "interval. Give the images of a frame the same number."
    )


def _alone(
    folders: PairedFolders, path: Path, color: set[int], depth: set[int], tolerance_s: float | None
) -> tuple[Notice, ...]:
    """Notices about images without a partner; depth images that are more frequent than color are usual."""
    within = "" if tolerance_s is None else f" within {1000 * tolerance_s:.0f} ms"
    told = []
    for names, paired, other in (
        (folders.color_names, color, "depth"),
        (folders.depth_names if tolerance_s is None else (), depth, "color"),
    ):
        alone = [name for row, name in enumerate(names) if row not in paired]
        if alone:
            told.append(
                Notice(
                    "images-left-out",
                    f"{len(alone)} of the {len(names)} {'color' if other == 'depth' else 'depth'} images of {path} "
                    f"{'is' if len(alone) == 1 else 'are'} left out: the first, {alone[0]}, has no {other} "
                    f"image{within}.",
                )
            )
    return tuple(told)
