"""Writes text into pictures, in whatever script: names of scans, words and classes are not all English."""

from __future__ import annotations

import importlib.util
import os
import sys
import unicodedata
from collections.abc import Iterator
from functools import lru_cache
from itertools import groupby, islice
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from ..core.errors import printable

HEADING, LEGEND, SMALL = 17, 14, 13
"""Sizes of text, pixels."""

_COLOR = (40, 40, 40)
_NO_CHARACTER = "\U0010fffd"  # private: what a font draws for it stands for every character that it lacks
_MOST_FILES = 1000
_OTHER_CUTS = ("bold", "italic", "oblique", "mono", "light", "thin", "black", "condensed")
_FOLDERS = {
    "win32": (f"{os.environ.get('WINDIR', 'C:/Windows')}/Fonts",),
    "darwin": ("/System/Library/Fonts", "/Library/Fonts", "~/Library/Fonts"),
}
_OTHER_FOLDERS = "/usr/share/fonts", "/usr/local/share/fonts", "~/.local/share/fonts", "~/.fonts"


def write_text(picture: NDArray[np.uint8], text: str, at: tuple[int, int], size: int) -> None:
    """Writes a line into (H, W, 3) ``picture``; what lies outside is cut off. at: x, y of the start of its baseline,
    pixels.  size: of the letters, pixels. A character that no font of this computer has is its code point, such as
    ``\\\\u4f60``."""
    width, rise = measure_text(text, size), 2 * size
    x, y = at[0], at[1] - rise
    canvas = Image.new("L", (max(1, width), 3 * size))
    draw, start = ImageDraw.Draw(canvas), 0.0
    for font, run in _runs(text, size):
        draw.text((start, rise), run, fill=255, font=font, anchor="ls")
        start += font.getlength(run)
    ink = np.asarray(canvas, np.float32)[max(0, -y) :, max(0, -x) :, None] / 255
    window = picture[max(0, y) : max(0, at[1] + size), max(0, x) : max(0, x + width)]
    ink = ink[: window.shape[0], : window.shape[1]]
    window[:] = np.rint(window + ink * (np.array(_COLOR) - window.astype(np.float32)))


def measure_text(text: str, size: int) -> int:
    """The width of what ``write_text`` writes, pixels."""
    return int(np.ceil(sum(font.getlength(run) for font, run in _runs(text, size))))


def _runs(text: str, size: int) -> Iterator[tuple[ImageFont.FreeTypeFont, str]]:
    """Parts of a line with the font of each. A name from right to left is a part, which leaves what follows it in its
    place."""
    letters = [_letter(character) for character in printable(unicodedata.normalize("NFC", text))]
    parts = [(file, any(map(_is_leftward, said))) for file, said in letters]
    for row in range(1, len(parts) - 1):  # a space belongs to the words on both of its sides
        if letters[row][1] == " " and parts[row - 1] == parts[row + 1]:
            parts[row] = parts[row - 1]
    for (file, _), run in groupby(zip(parts, letters, strict=True), key=lambda pair: pair[0]):
        yield _font(file, size), "".join(said for _, (_, said) in run)


def _is_leftward(character: str) -> bool:
    return unicodedata.bidirectional(character) in ("R", "AL")


@lru_cache(maxsize=4096)
def _letter(character: str) -> tuple[str, str]:
    """The first font that has a character, and what it writes: where there is none, the letter without its accents, or
    else the code point."""
    if character.isascii():
        return _MAIN, character
    for file in _font_files():
        if _has(file, character):
            return file, character
    plain = unicodedata.normalize("NFKD", character)[0]
    return _MAIN, plain if plain.isascii() and plain.isprintable() else ascii(character)[1:-1]


@lru_cache(maxsize=1)
def _font_files() -> tuple[str, ...]:
    """The main font, and the upright ones of this computer."""
    folders = [Path(folder).expanduser() for folder in _FOLDERS.get(sys.platform, _OTHER_FOLDERS)]
    found = (path for folder in folders for path in folder.rglob("*.[oOtT][tT][fFcC]"))
    plain = (path for path in found if not any(cut in path.name.lower() for cut in _OTHER_CUTS))
    return _MAIN, *sorted(map(str, islice(plain, _MOST_FILES)))


def _has(file: str, character: str) -> bool:
    try:
        font = _font(file, LEGEND)
        drawn = bytes(font.getmask(character))
        return any(drawn) and drawn != bytes(font.getmask(_NO_CHARACTER))
    except (OSError, ValueError):
        return False  # a font of pictures, or a file that is no font


@lru_cache(maxsize=64)
def _font(file: str, size: int) -> ImageFont.FreeTypeFont:
    if file:
        return ImageFont.truetype(file, size)
    font = ImageFont.load_default(size)
    assert isinstance(font, ImageFont.FreeTypeFont)
    return font


def _find_main() -> str:
    """DejaVu Sans has Latin, Greek, Cyrillic, Arabic and Hebrew letters; it comes with matplotlib, which PyVista
    needs. Without it, "" for Pillow's own font."""
    found = importlib.util.find_spec("matplotlib")
    path = Path(found.origin).parent / "mpl-data/fonts/ttf/DejaVuSans.ttf" if found and found.origin else None
    return str(path) if path is not None and path.is_file() else ""


_MAIN = _find_main()
