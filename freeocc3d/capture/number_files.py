"""Reads text files, and those of numbers, such as matrices and lists of poses, in memory that their size bounds."""

from __future__ import annotations

from array import array
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..core import regular_files
from ..core.errors import CaptureError

POSES_BYTES = 64 << 20
"""Largest file of poses: those of half a million frames."""

JSON_BYTES = 32 << 20
"""Largest JSON document: the poses of 30,000 frames. Python takes up to 40 times as much memory for its values."""

MATRIX_BYTES = 1 << 16
"""Largest file of one matrix."""

_MOST_IN_ROW = 16


@dataclass(frozen=True)
class NumberRows:
    """The numbers of all lines. values: (K,) float64.  lengths: (L,) how many each line holds, 1 to 16."""

    values: NDArray[np.float64]
    lengths: NDArray[np.uint8]

    def table(self) -> NDArray[np.float64] | None:
        """(L, columns) numbers; None if the lines differ in length, or there are none."""
        if not len(self.lengths) or (self.lengths != self.lengths[0]).any():
            return None
        return self.values.reshape(len(self.lengths), -1)


def read_text(path: Path, limit: int = regular_files.TEXT_BYTES) -> str:
    """Read the text of a regular file of at most ``limit`` bytes. Raises CaptureError."""
    try:
        return regular_files.read_text(path, limit)
    except OSError as error:
        raise CaptureError(f"Cannot read {path}: {error.strerror}.") from error
    except UnicodeDecodeError as error:
        raise CaptureError(f"{path} is not a text file.") from error


def read_number_rows(path: Path, limit: int = POSES_BYTES) -> NumberRows:
    """Read lines of numbers, separated by spaces or commas; empty lines and those after ``#`` are left out.

    Raises CaptureError if the file cannot be read, ValueError for a word, or for a line of more than 16 numbers.
    """
    values, lengths = array("d"), array("B")
    for line in read_text(path, limit).splitlines():
        words = line.replace(",", " ").split(maxsplit=_MOST_IN_ROW)
        if not words or words[0].startswith("#"):
            continue
        if len(words) > _MOST_IN_ROW:
            raise ValueError(f"a line holds more than {_MOST_IN_ROW} numbers")
        values.extend(map(float, words))
        lengths.append(len(words))
    return NumberRows(np.array(values, np.float64), np.array(lengths, np.uint8))
