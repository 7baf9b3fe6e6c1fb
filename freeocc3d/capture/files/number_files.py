"""Reads text files, and those of numbers, such as matrices and lists of poses, in memory that their size bounds."""

from __future__ import annotations

import contextlib
import re
from array import array
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...core import regular_files
from ...core.errors import CaptureError

POSES_BYTES = 64 << 20
"""Largest file of poses: those of half a million frames."""

JSON_BYTES = 32 << 20
"""Largest JSON document: the poses of 30,000 frames. Python takes up to 40 times as much memory for its values."""

MATRIX_BYTES = 1 << 16
"""Largest file of one matrix."""

MOST_IN_ROW = 64
"""Most numbers of a line: EuRoC's ground truth has 17."""

_MOST_HEADINGS, _LONGEST_HEADING = 100, 4096
_NOT_OF_TEXT = re.compile(r"[\x00-\x08\x0e-\x1f]")


@dataclass(frozen=True)
class NumberRows:
    """The numbers of all lines. values: (K,) float64.  lengths: (L,) how many each line holds, 1 to ``MOST_IN_ROW``.
    lines: (L,) their numbers in the file, from 1.  headings: the lines of words and comments before the first."""

    values: NDArray[np.float64]
    lengths: NDArray[np.uint8]
    lines: NDArray[np.int32]
    headings: tuple[str, ...] = ()

    def table(self) -> NDArray[np.float64] | None:
        """(L, columns) numbers; None if the lines differ in length, or there are none."""
        if not len(self.lengths) or (self.lengths != self.lengths[0]).any():
            return None
        return self.values.reshape(len(self.lengths), -1)

    def column(self, index: int) -> NDArray[np.float64]:
        """(L,) the number at that place of each line; NaN where a line is shorter."""
        starts = np.cumsum(self.lengths, dtype=np.int64) - self.lengths
        there = self.lengths > index
        found = np.full(len(self.lengths), np.nan)
        found[there] = self.values[starts[there] + index]
        return found


def read_text(path: Path, limit: int = regular_files.TEXT_BYTES) -> str:
    """Read the text of a regular file of at most ``limit`` bytes. Raises CaptureError."""
    try:
        return regular_files.read_text(path, limit)
    except OSError as error:
        raise CaptureError(f"Cannot read {path}: {error.strerror}.") from error
    except UnicodeDecodeError as error:
        raise CaptureError(f"{path} is not a text file.") from error


def read_number_rows(path: Path, limit: int = POSES_BYTES, headed: bool = False) -> NumberRows:
    """Read lines of numbers, separated by spaces, tabs, commas or semicolons; empty lines and those after ``#`` are
    left out. A cell without a number, between two separators, is NaN. Beside ASCII, comments may be in any encoding.

    headed: whether the first line may be one of words, such as the names of columns. Raises CaptureError if the file
    cannot be read, ValueError with the line of a word, or of more than ``MOST_IN_ROW`` numbers.
    """
    values, lengths, lines, headings = array("d"), array("B"), array("i"), list[str]()
    text = _decode(path, limit).replace("\r\n", "\n").replace("\r", "\n")
    for number, line in enumerate(text.split("\n"), 1):
        line = line.strip()
        if not line or line.startswith("#"):
            if not lengths and line and len(headings) < _MOST_HEADINGS:
                headings.append(line[:_LONGEST_HEADING])
            continue
        cells = _cells(line)
        if len(cells) > MOST_IN_ROW:
            raise ValueError(f"line {number} holds more than {MOST_IN_ROW} numbers")
        try:
            found = list(map(float, cells))
        except ValueError:
            if headed and not lengths and not _is_number(cells[0]):
                headings.append(line[:_LONGEST_HEADING])
                headed = False
                continue
            word = next(cell for cell in cells if not _is_number(cell))
            raise ValueError(f"line {number} holds {word[:40]!r}, which is no number") from None
        values.extend(found)
        lengths.append(len(found))
        lines.append(number)
    return NumberRows(
        np.array(values, np.float64), np.array(lengths, np.uint8), np.array(lines, np.int32), tuple(headings)
    )


def _decode(path: Path, limit: int) -> str:
    """The text of a file of numbers. Those of other systems have comments in the encoding of their country. Raises
    CaptureError."""
    try:
        data = regular_files.read_bytes(path, limit)
    except OSError as error:
        raise CaptureError(f"Cannot read {path}: {error.strerror}.") from error
    text = None
    for encoding in ("utf-16",) if data[:2] in (b"\xff\xfe", b"\xfe\xff") else ("utf-8-sig", "latin-1"):
        with contextlib.suppress(UnicodeDecodeError):
            text = data.decode(encoding)
            break
    if text is None or _NOT_OF_TEXT.search(text):
        raise CaptureError(f"{path} is not a text file.")
    return text


def _cells(line: str) -> list[str]:
    """The cells of a line; one without text is "nan", but those at the end are left out."""
    if ";" in line and "." not in line:  # where a comma is the point
        line = line.replace(",", ".")
    separator = ";" if ";" in line else ","
    if separator not in line:
        return line.split(maxsplit=MOST_IN_ROW)
    cells = [cell.strip() for cell in line.split(separator, MOST_IN_ROW + 1)]
    while len(cells) > 1 and not cells[-1]:
        cells.pop()
    if any(len(cell.split(maxsplit=1)) > 1 for cell in cells):  # separated by both
        return line.replace(separator, " ").split(maxsplit=MOST_IN_ROW)
    return [cell or "nan" for cell in cells]


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True
