"""Reads the lists of TUM's RGB-D benchmark: ``rgb.txt``, ``depth.txt``, and associations of the two in either order.

Source: J. Sturm et al., A Benchmark for the Evaluation of RGB-D SLAM Systems, IROS 2012; its script associate.py.
"""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray

from ..core.errors import CaptureError, FrameError
from ..core.warnings import Notice
from .files.file_finding import FileFinder, report_missing
from .files.name_matching import FEWEST_PAIRED, Column, associate_nearest, order_names, time_tolerance
from .files.number_files import read_text
from .files.numbered_files import list_folder
from .files.paired_folders import ImagePair, PairList
from .frame_files import notice_left_out
from .images.depth_decoding import read_raw_depth

_COLOR_LIST = re.compile(r"(?:rgb|colou?r|images?)(?:[_-]?(?:list|images?|files?))?\.txt", re.IGNORECASE)
_DEPTH_LIST = re.compile(r"(?:aligned[_-]?)?depths?(?:[_-]?(?:list|images?|files?))?\.txt", re.IGNORECASE)
_ASSOCIATIONS = re.compile(r"(?:.*[\W_])?assoc(?:iat(?:e|ed|ions?))?s?(?:[\W_].*)?\.txt", re.IGNORECASE)
_OF_DEPTH = re.compile(r"depth|disp", re.IGNORECASE)
_LISTS_BYTES = 64 << 20


@dataclass(frozen=True)
class ListFiles:
    """The lists of a folder: associations, or one of color and one of depth."""

    associations: Path | None
    color: Path | None
    depth: Path | None

    @property
    def usable(self) -> bool:
        return self.associations is not None or (self.color is not None and self.depth is not None)


@dataclass(frozen=True)
class _Entries:
    """The lines of a list: (N,) seconds and the names of images."""

    times: NDArray[np.float64]
    names: tuple[str, ...]


def find_lists(path: Path) -> ListFiles:
    """The lists of ``path``, by their names."""
    names = [name for name in list_folder(path) if not name.startswith(".")]
    found = (next((name for name in names if kind.fullmatch(name)), None)
             for kind in (_ASSOCIATIONS, _COLOR_LIST, _DEPTH_LIST))  # fmt: skip
    return ListFiles(*(path / name if name else None for name in found))


def read_lists(lists: ListFiles, path: Path, with_depth: bool) -> tuple[PairList, bool]:
    """The frames that lists state, and whether depth comes first with frame numbers as times, as ICL-NUIM has it.

    Files that are missing are left out with a warning. Raises CaptureError: a line that is not understood, or too few
    files or pairs.
    """
    if lists.associations is not None:
        return _read_associations(lists.associations, path, with_depth)
    if lists.color is None or (lists.depth is None and with_depth):
        raise CaptureError(
            f"{path} holds no lists of color and depth images: it needs rgb.txt and depth.txt (lines 'time path'), or "
            "associations.txt (lines 'time path time path')."
        )
    color, notices = _existing(_read_list(lists.color), path, lists.color, "color")
    if not with_depth or lists.depth is None:
        return _ordered(color, [(row, None) for row in range(len(color.names))], notices), False
    depth, missing = _existing(_read_list(lists.depth), path, lists.depth, "depth")
    tolerance = time_tolerance(color.times, depth.times)
    own, other = associate_nearest(color.times, depth.times, tolerance)
    if len(own) < FEWEST_PAIRED * min(len(color.names), len(depth.names)):
        raise CaptureError(
            f"{len(own)} of the {len(color.names)} images of {lists.color} and {len(depth.names)} of {lists.depth} "
            f"have times that differ by at most {1000 * tolerance:.0f} ms: the first are {color.times[0]:.6f} "
            f"({color.names[0]}) and {depth.times[0]:.6f} ({depth.names[0]}). Correct the times."
        )
    alone = sorted(set(range(len(color.names))) - set(own.tolist()))
    if alone:
        reason = f"has no depth image within {1000 * tolerance:.0f} ms"
        notices += (notice_left_out(len(alone), len(color.names), path, color.names[alone[0]], reason),)
    pairs = [(row, depth.names[place]) for row, place in zip(own.tolist(), other.tolist(), strict=True)]
    return _ordered(color, pairs, notices + missing), False


def read_comments(files: Sequence[Path | None]) -> str:
    """The comments at the start of text files, which name the recording."""
    found = list[str]()
    for file in files:
        if file is not None:
            lines = read_text(file, _LISTS_BYTES).splitlines()[:10]
            found += [line for line in lines if line.lstrip().startswith("#")]
    return "\n".join(found)


def _words(file: Path, count: int) -> list[tuple[int, list[str]]]:
    """Line numbers and words of all lines but comments and headings. Raises CaptureError for a line of fewer words."""
    found = list[tuple[int, list[str]]]()
    for number, line in enumerate(read_text(file, _LISTS_BYTES).splitlines(), 1):
        words = line.replace(",", " ").split() if count > 2 else re.split(r"[\s,]+", line.strip(), maxsplit=1)
        if not words or not words[0] or words[0].startswith("#"):
            continue
        if len(words) < count or not _is_time(words[0]):
            if not found:  # a heading
                continue
            form = "time path time path" if count > 2 else "time path"
            raise CaptureError(f"Line {number} of {file} does not read '{form}': {line.strip()[:80]!r}. Correct it.")
        found.append((number, words))
    if not found:
        raise CaptureError(f"{file} lists no images.")
    return found


def _is_time(word: str) -> bool:
    try:
        return len(word) <= 40 and math.isfinite(float(word))
    except ValueError:
        return False


def _seconds(words: Sequence[str]) -> NDArray[np.float64]:
    """(N,) times that are stated in seconds or, since 1970, in milli-, micro- or nanoseconds."""
    times = np.array([float(word) for word in words])
    units = Column(tuple(map(int, times.tolist()))).epoch_units() or 1
    return times / units


def _read_list(file: Path) -> _Entries:
    lines = _words(file, 2)
    return _Entries(_seconds([words[0] for _, words in lines]), tuple(words[1].strip() for _, words in lines))


def _existing(entries: _Entries, path: Path, file: Path, kind: str) -> tuple[_Entries, tuple[Notice, ...]]:
    """The entries whose files are there, with their paths as names, each once."""
    finder = FileFinder(path, "color" if kind == "color" else "depth")
    found = finder.find_all(entries.names)
    notices = report_missing(entries.names, found, finder, str(file), f"{kind} images")
    kept = {str(place): row for row, place in reversed(list(enumerate(found))) if place is not None}
    rows = sorted(kept.values())
    return _Entries(entries.times[rows], tuple(str(found[row]) for row in rows)), notices


def _read_associations(file: Path, path: Path, with_depth: bool) -> tuple[PairList, bool]:
    lines = [words for _, words in _words(file, 4)]
    first, second = ([words[place] for words in lines] for place in (1, 3))
    swapped = _depth_is_first(first[0], second[0], path)
    times = _seconds([words[2 if swapped and _is_time(words[2]) else 0] for words in lines])
    color, depth = (second, first) if swapped else (first, second)
    finders = FileFinder(path, "color"), FileFinder(path, "depth")
    found, found_depth = (finder.find_all(names) for finder, names in zip(finders, (color, depth), strict=True))
    notices = report_missing(color, found, finders[0], str(file), "color images")
    if with_depth:
        notices += report_missing(depth, found_depth, finders[1], str(file), "depth images")
    kept = dict[str, tuple[int, str | None]]()
    for row, (a, b) in enumerate(zip(found, found_depth, strict=True)):
        if a is not None and (b is not None or not with_depth):
            kept.setdefault(str(a), (row, str(b) if with_depth else None))
    if not kept:
        raise CaptureError(f"No pair of {file} has both its images in {path}.")
    entries = _Entries(times[[row for row, _ in kept.values()]], tuple(kept))
    pairs = [(row, partner) for row, (_, partner) in enumerate(kept.values())]
    frames = _ordered(entries, pairs, notices)
    return frames, swapped and all(entries.times[pair.row] == pair.number for pair in frames.pairs)


def _depth_is_first(first: str, second: str, path: Path) -> bool:
    """Whether the first of two images is the depth, by their names or, if those say nothing, by their content."""
    in_names = _OF_DEPTH.search(first) is not None, _OF_DEPTH.search(second) is not None
    if in_names[0] != in_names[1]:
        return in_names[0]
    finder = FileFinder(path)
    file = finder.find(first)
    try:
        return file is not None and read_raw_depth(file).ndim == 2
    except FrameError:
        return False


def _ordered(color: _Entries, pairs: Sequence[tuple[int, str | None]], notices: tuple[Notice, ...]) -> PairList:
    """Frames in the order of time or, if the times are not in the order of the names, of the names."""
    by_name = order_names([PurePosixPath(name).name for name in color.names])
    place_of = {row: place for place, row in enumerate(by_name.first)}
    numbers = dict(zip(by_name.first, by_name.numbers, strict=True)) if by_name.numbers else {}
    by_time = sorted(pairs, key=lambda pair: (color.times[pair[0]], place_of.get(pair[0], pair[0])))
    places = [place_of.get(row, row) for row, _ in by_time]
    listed = [color.times[row] for row, _ in pairs]
    has_times = places == sorted(places) or all(a < b for a, b in itertools.pairwise(listed))
    order = by_time if has_times else sorted(pairs, key=lambda pair: place_of.get(pair[0], pair[0]))
    frames = [
        ImagePair(Path(color.names[row]), Path(depth) if depth else None,
                  float(color.times[row]) if has_times else float(place), numbers.get(row), row)
        for place, (row, depth) in enumerate(order)
    ]  # fmt: skip
    if has_times and numbers and all(pair.number == pair.time for pair in frames):  # frame numbers, not seconds
        frames = [replace(pair, time=float(place)) for place, pair in enumerate(frames)]
        has_times = False
    return PairList(tuple(frames), has_times, len(color.names), notices)
