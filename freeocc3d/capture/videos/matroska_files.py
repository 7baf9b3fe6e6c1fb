"""Reads Matroska files (.mkv) of cameras: tracks, tags, attachments, and where the blocks of a track lie.

Opening walks over the headers of clusters and blocks and reads no block. Source: RFC 8794 (EBML), RFC 9559 (Matroska).
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..files.file_bytes import Bytes, DamagedFile, FileBytes, HeldBytes

START = b"\x1a\x45\xdf\xa3"

_SEGMENT_NAME = 4  # bytes
_SEGMENT, _INFO, _TRACKS, _CLUSTER, _ATTACHMENTS, _TAGS = (
    0x18538067, 0x1549A966, 0x1654AE6B, 0x1F43B675, 0x1941A469, 0x1254C367,
)  # fmt: skip
_TOP = {_INFO, _TRACKS, _CLUSTER, _ATTACHMENTS, _TAGS, 0x114D9B74, 0x1C53BB6B, 0x1043A770}
"""Children of a segment, also SeekHead, Cues and Chapters; one of them ends a cluster of unknown size."""
_SCALE = 0x2AD7B1
_ENTRY, _NUMBER, _UID, _NAME, _CODEC, _PRIVATE, _ENCODINGS = 0xAE, 0xD7, 0x73C5, 0x536E, 0x86, 0x63A2, 0x6D80
_VIDEO, _WIDTH, _HEIGHT = 0xE0, 0xB0, 0xBA
_TIMESTAMP, _SIMPLE, _GROUP, _BLOCK = 0xE7, 0xA3, 0xA0, 0xA1
_FILE, _FILE_NAME, _FILE_DATA = 0x61A7, 0x466E, 0x465C
_TAG, _SIMPLE_TAG, _TAG_NAME, _TAG_TEXT = 0x7373, 0x67C8, 0x45A3, 0x4487

_LONGEST_HEAD = 32  # bytes of an element's id and size, and of what a block says about itself
_MOST_HELD = 4 << 20
"""Largest element that is read at once: tracks, tags, an attachment."""
_MOST_ELEMENTS = 10_000_000
"""Most elements that are visited: the blocks of hours."""
_MOST_NUMBERS = 8
_LACING = 0x06


@dataclass(frozen=True)
class Track:
    """A stream. private: what its codec says about it.  packed: whether its blocks are compressed or encrypted."""

    number: int
    uid: int
    name: str
    codec: str
    private: bytes
    width: int
    height: int
    packed: bool

    @property
    def fourcc(self) -> str:
        """The name of a codec of Windows, in the BITMAPINFOHEADER of its private data; "" for others."""
        windows = self.codec == "V_MS/VFW/FOURCC" and len(self.private) >= 20
        return self.private[16:20].decode("ascii", "replace") if windows else ""


@dataclass
class _Found:
    tracks: list[Track] = field(default_factory=list)
    tags: dict[str, str] = field(default_factory=dict)
    attachments: dict[str, tuple[int, int]] = field(default_factory=dict)
    blocks: list[tuple[int, int, int, int]] = field(default_factory=list)
    nanoseconds: int = 1_000_000
    visited: int = 0
    cut_off: bool = False

    def visit(self) -> None:
        """Count an element. Raises DamagedFile if there are too many."""
        self.visited += 1
        if self.visited > _MOST_ELEMENTS:
            raise DamagedFile(f"it has more than {_MOST_ELEMENTS:,} parts")


class MatroskaFile:
    """A file. Thread-safe. The constructor raises DamagedFile, OSError.

    tracks, tags: as the file states them.  cut_off: whether it is shorter than it states.  times_s, places: of each
    track's blocks, by its number: (N,) seconds, ascending, and (N, 2) offset and size.
    """

    def __init__(self, path: Path):
        self._file = FileBytes(path)
        found = _Found()
        try:
            _walk(self._file, found, tracks_only=False)
        except (struct.error, UnicodeDecodeError, IndexError) as error:
            raise DamagedFile("it is damaged or cut off") from error
        self.tracks, self.tags, self._attachments = found.tracks, found.tags, found.attachments
        self.cut_off = found.cut_off
        table = np.array(found.blocks, np.int64).reshape(-1, 4)
        self.times_s: dict[int, NDArray[np.float64]] = {}
        self.places: dict[int, NDArray[np.int64]] = {}
        for track in self.tracks:
            own = table[table[:, 0] == track.number]
            own = own[np.argsort(own[:, 1], kind="stable")]
            self.times_s[track.number] = own[:, 1] * (found.nanoseconds * 1e-9)
            self.places[track.number] = own[:, 2:]

    def block(self, track: Track, row: int) -> bytes:
        """The data of a block. Raises DamagedFile, OSError."""
        offset, size = self.places[track.number][row].tolist()
        return self._file.read(offset, size)

    def attachment(self, name: str) -> bytes | None:
        """The content of an attached file, None if there is none. Raises DamagedFile, OSError."""
        place = self._attachments.get(name)
        return None if place is None else self._file.read(*place)


def read_tracks(path: Path) -> list[Track]:
    """The tracks of a file, without a look at the rest. Raises DamagedFile, OSError."""
    found = _Found()
    try:
        _walk(FileBytes(path), found, tracks_only=True)
    except (struct.error, UnicodeDecodeError, IndexError) as error:
        raise DamagedFile("it is damaged or cut off") from error
    return found.tracks


def _walk(source: Bytes, found: _Found, tracks_only: bool) -> None:
    """Note what the segments hold. A file that is cut off is read up to there."""
    if source.size < len(START) or source.read(0, len(START)) != START:
        raise DamagedFile("it is no Matroska file")
    begin = 0
    for name, at, end in _elements(source, 0, source.size):
        begin, head = end, source.read(begin, at - begin)
        if name != _SEGMENT:
            continue
        stated = _size(head, _SEGMENT_NAME)[0]
        found.cut_off |= stated is not None and at + stated > source.size
        for child, start, stop in _elements(source, at, end):
            found.visit()
            if child == _TRACKS:
                found.tracks += _tracks(_held(source, start, stop))
                if tracks_only:
                    return
            elif child == _CLUSTER:
                _note_blocks(source, start, stop, found)
            elif not tracks_only:
                _note_rest(source, child, start, stop, found)


def _note_rest(source: Bytes, child: int, start: int, stop: int, found: _Found) -> None:
    if child == _INFO:
        values = _values(_held(source, start, stop))
        found.nanoseconds = _number(values.get(_SCALE)) or found.nanoseconds
    elif child == _TAGS:
        found.tags.update(_tags(_held(source, start, stop)))
    elif child == _ATTACHMENTS:
        for name, at, end in _elements(source, start, stop):
            if name == _FILE:
                parts = {part: (low, high) for part, low, high in _elements(source, at, end)}
                if _FILE_NAME in parts and _FILE_DATA in parts:
                    low, high = parts[_FILE_DATA]
                    text = _held(source, *parts[_FILE_NAME])
                    if high - low <= _MOST_HELD:
                        found.attachments[text.read(0, text.size).rstrip(b"\0").decode()] = low, high - low


def _note_blocks(source: Bytes, start: int, stop: int, found: _Found) -> None:
    time = 0
    for name, at, end in _elements(source, start, stop):
        found.visit()
        if name == _TIMESTAMP:
            time = _number(source.read(at, min(end - at, _MOST_NUMBERS)))
        elif name == _SIMPLE:
            _note_block(source, at, end, time, found)
        elif name == _GROUP:
            for inner, low, high in _elements(source, at, end):
                if inner == _BLOCK:
                    _note_block(source, low, high, time, found)


def _note_block(source: Bytes, at: int, end: int, time: int, found: _Found) -> None:
    head = source.read(at, min(_LONGEST_HEAD, end - at))
    number, used = _size(head, 0)
    if number is None or used + 3 > len(head):
        return
    offset, flags = struct.unpack_from(">hB", head, used)
    if not flags & _LACING:  # several frames in one block: sound and motion, not images
        found.blocks.append((number, time + offset, at + used + 3, end - at - used - 3))


def _tracks(source: Bytes) -> Iterator[Track]:
    for name, at, end in _elements(source, 0, source.size):
        if name == _ENTRY:
            values = _values(_held(source, at, end))
            video = _values(HeldBytes(values.get(_VIDEO, b"")))
            yield Track(
                _number(values.get(_NUMBER)), _number(values.get(_UID)), _text(values.get(_NAME)),
                _text(values.get(_CODEC)), values.get(_PRIVATE, b""), _number(video.get(_WIDTH)),
                _number(video.get(_HEIGHT)), _ENCODINGS in values,
            )  # fmt: skip


def _tags(source: Bytes) -> dict[str, str]:
    found = {}
    for name, at, end in _elements(source, 0, source.size):
        for inner, low, high in _elements(source, at, end) if name == _TAG else ():
            if inner == _SIMPLE_TAG:
                values = _values(_held(source, low, high))
                found[_text(values.get(_TAG_NAME))] = _text(values.get(_TAG_TEXT))
    return found


def _elements(source: Bytes, at: int, end: int) -> Iterator[tuple[int, int, int]]:
    """Name, and offsets of the content's start and end, of the elements between two offsets. What is cut off ends."""
    while at + 2 <= end:
        head = source.read(at, min(_LONGEST_HEAD, end - at))
        length = 8 - head[0].bit_length() + 1
        if not 1 <= length <= 4 or length >= len(head):
            return
        name = int.from_bytes(head[:length], "big")
        size, used = _size(head, length)
        start = at + used
        if used > len(head):
            return
        stop = end if size is None else start + size
        if size is None and name == _CLUSTER:
            stop = _end_of_cluster(source, start, end)
        if stop > end:
            if name not in (_SEGMENT, _CLUSTER):
                return
            stop = end
        yield name, start, stop
        at = stop


def _end_of_cluster(source: Bytes, at: int, end: int) -> int:
    """Where a cluster of unknown size ends: at the next element that is a child of the segment."""
    while at + 2 <= end:
        head = source.read(at, min(_LONGEST_HEAD, end - at))
        if len(head) >= 4 and int.from_bytes(head[:4], "big") in _TOP:
            return at
        length = 8 - head[0].bit_length() + 1
        if not 1 <= length <= 4 or length >= len(head):
            break
        size, used = _size(head, length)
        if size is None or at + used + size > end:
            break
        at += used + size
    return min(at, end) if at + 2 > end else end


def _size(head: bytes, at: int) -> tuple[int | None, int]:
    """A number of variable length, None if it states that the size is unknown, and the offset after it."""
    length = 8 - head[at].bit_length() + 1
    if length > 8:
        raise DamagedFile("it is damaged: an element has no size")
    value = int.from_bytes(head[at : at + length], "big") & ((1 << 7 * length) - 1)
    return (None if value == (1 << 7 * length) - 1 else value), at + length


def _held(source: Bytes, start: int, stop: int) -> HeldBytes:
    if stop - start > _MOST_HELD:
        raise DamagedFile(f"it is damaged: a part that describes it has {stop - start} bytes")
    return HeldBytes(source.read(start, stop - start))


def _values(source: Bytes) -> dict[int, bytes]:
    """Name -> content of the elements; of several of one name, the last."""
    return {name: source.read(at, end - at) for name, at, end in _elements(source, 0, source.size)}


def _number(data: bytes | None) -> int:
    return int.from_bytes((data or b"")[:_MOST_NUMBERS], "big")


def _text(data: bytes | None) -> str:
    return (data or b"").rstrip(b"\0").decode()
