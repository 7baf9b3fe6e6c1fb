"""Looks at the head of every file of a capture before a run, so that what is missing or empty is told at once."""

from __future__ import annotations

from pathlib import Path

from ...core.errors import CaptureError
from ...core.regular_files import open_regular
from ...core.warnings import Notice
from ..base import Capture

_HEADS = {
    ".png": (b"\x89PNG\r\n\x1a\n",), ".jpg": (b"\xff\xd8",), ".jpeg": (b"\xff\xd8",), ".bmp": (b"BM",),
    ".tif": (b"II", b"MM"), ".tiff": (b"II", b"MM"), ".webp": (b"RIFF",), ".exr": (b"\x76\x2f\x31\x01",),
    ".npy": (b"\x93NUMPY",), ".npz": (b"PK",), ".pgm": (b"P5", b"P2"), ".pfm": (b"Pf", b"PF"),
}  # fmt: skip
"""Suffix -> the first bytes of such files."""

_ANY_IMAGE = tuple(head for suffix in (".png", ".jpg", ".bmp", ".tif", ".webp") for head in _HEADS[suffix])


def check_heads(capture: Capture, frames: range) -> Notice | None:
    """A warning if files of the selected frames are missing, empty, or begin as no image does.

    Raises CaptureError if more than the share ``capture.max_broken`` of the frames have such a file.
    """
    bad: dict[int, str] = {}
    count = len(frames)
    for index in frames:
        for path in capture.files(index):
            if reason := find_problem(path):
                bad.setdefault(index, f"{path} {reason}")
    if not bad:
        return None
    said = f"{len(bad)} of {count} frames of {capture.path} have a file that cannot be read. The first: "
    said += f"{next(iter(bad.values()))}."
    if len(bad) > capture.options.max_broken * count:
        raise CaptureError(f"{said} Repair the capture, or raise capture.max_broken.")
    return Notice("images-unreadable", said)


def find_problem(path: Path) -> str:
    """Why a file cannot be an image of its suffix, as the end of a sentence; empty if its head is right. JPEG, PNG,
    TIFF, BMP and WebP stand for one another, as decoders go by content."""
    try:
        with open_regular(path) as stream:
            head = stream.read(8)
    except OSError as error:
        return f"cannot be opened: {error.strerror}"
    if not head:
        return "is empty"
    expected = _HEADS.get(path.suffix.lower())
    if expected is None or head.startswith(expected):
        return ""
    if expected[0] in _ANY_IMAGE and head.startswith(_ANY_IMAGE):
        return ""
    return "is not an image"
