"""Pairs the color and depth files of two folders by what their names say: numbers, times, or both.

Names come in every form: ``12.jpg``, ``frame-000012.color.png``, ``0000012-000000400000.png`` (Redwood: number and
microseconds), ``1305031102.175304.png`` (TUM: seconds), ``color_1633338412000.jpg`` (milliseconds). The number of a
frame is the one that differs between the names of a folder; numbers that are equal in both folders pair files, and
where few are, the nearest times do.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

SAME_TIME_S = 0.02
"""Times that differ by at most this always match, as in the TUM RGB-D benchmark."""

FARTHEST_S = 0.1
"""Times that differ by more never match, however rare the frames are."""

FRAME_INTERVALS_S = 0.004, 2.0
"""Intervals between the frames of a recording."""

FEWEST_PAIRED = 0.5
"""Files match if this share of the smaller folder does."""

USUAL_FORM = 0.8
"""Names of other forms than this share of a folder has are no frames."""

_EPOCH_S = 1e9, 1e10
"""Seconds since 1970 of the years 2001 to 2286."""

_NANO = 10**9
_DIGITS = re.compile(r"\d+")
_MOST_DIGITS, _MOST_NUMBERS, _LONGEST_NAME = 30, 10, 255
_PADDED_MICROSECONDS = 9


@dataclass(frozen=True)
class Column:
    """One number of each name of a folder, all different. kind: "number"; "decimal", in units of 1e-9; or "name" for
    the whole name as one number.  padded: how many digits all of them have, 0 = not the same."""

    values: tuple[int, ...]
    kind: Literal["number", "decimal", "name"] = "number"
    padded: int = 0

    def units_per_second(self) -> int | None:
        """Units of a second that the values are in, if they are times: seconds, milli-, micro- or nanoseconds since
        1970 or, by the intervals between them, since the start; None if they are no times."""
        if stated := self.epoch_units():
            return stated
        if self.kind == "name" or len(self.values) < 2:
            return None
        interval = float(np.median(np.diff(np.sort(self.floats()))))
        low, high = FRAME_INTERVALS_S
        return next((units for units in (10**3, 10**6, _NANO) if low <= interval / units <= high), None)

    def epoch_units(self) -> int | None:
        """As ``units_per_second``, for decimals and times since 1970 alone."""
        if self.kind != "number":
            return _NANO if self.kind == "decimal" else None
        low, high = _EPOCH_S
        smallest, largest = min(self.values), max(self.values)
        return next((u for u in (1, 10**3, 10**6, _NANO) if low <= smallest / u <= largest / u <= high), None)

    def floats(self, start: int = 0) -> NDArray[np.float64]:
        """(N,) values since ``start``."""
        return np.array([value - start for value in self.values], np.float64)

    def times(self, rows: Sequence[int], units: int) -> NDArray[np.float64]:
        """(M,) seconds of some rows."""
        return np.array([self.values[row] / units for row in rows], np.float64)


@dataclass(frozen=True)
class Matches:
    """Pairs of rows of two lists of names, in the order of the first's numbers. first, second: (M,) rows.

    times: (M,) seconds of the first, ascending, or None.  numbers: the numbers that order them, or () if there are
    none.  tolerance_s: how much times may differ, if times paired the names; else None.
    """

    first: tuple[int, ...]
    second: tuple[int, ...]
    times: NDArray[np.float64] | None = None
    numbers: tuple[int, ...] = ()
    tolerance_s: float | None = None


def match_names(first: Sequence[str], second: Sequence[str], by_time: bool = True) -> Matches:
    """Pair two lists of file names. by_time: also by the nearest time, else by equal numbers alone."""
    rows, rows_second = _alike(first), _alike(second)
    own, other = find_columns([first[row] for row in rows]), find_columns([second[row] for row in rows_second])
    best = _longest([_equal(a, b) for a in own for b in other if a.kind == b.kind])
    if by_time and len(best) < FEWEST_PAIRED * min(len(rows), len(rows_second)):
        best = _longest([best, *(_nearest(a, b) for a in own for b in other if a.kind == b.kind)])
    if not len(best):
        best = _longest([_shifted(a, b) for a in own for b in other if a.kind == b.kind == "number"])
    found = _in_order(best, own)
    kept = tuple(rows[row] for row in found.first), tuple(rows_second[row] for row in found.second)
    return replace(found, first=kept[0], second=kept[1])


def order_names(names: Sequence[str]) -> Matches:
    """The names in the order of their numbers, paired with themselves."""
    return match_names(names, names, by_time=False)


def are_seconds(names: Sequence[str]) -> bool:
    """Whether names are times in seconds with decimals, as those of TUM's images."""
    columns = find_columns([names[row] for row in _alike(names)])
    return bool(columns) and columns[0].kind == "decimal"


def find_columns(names: Sequence[str]) -> list[Column]:
    """The numbers that differ from name to name, those with a decimal point first; last the whole names. All names
    hold equally many numbers. Empty if names say nothing."""
    stems = [_stem(name).lower() for name in names]
    if not stems:
        return []
    digits = [_numbers(stem) for stem in stems]
    count = len(digits[0])
    columns = [column for place in range(count - 1) if (column := _decimals(stems, digits, place))]
    columns += [_column([numbers[place] for numbers in digits]) for place in range(count)]
    columns.append(Column(tuple(map(_whole, stems, digits)), "name"))
    return [column for column in columns if len(set(column.values)) == len(names)]


def associate_nearest(
    a: NDArray[np.float64], b: NDArray[np.float64], tolerance: float
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Pairs of rows of two lists of times, each used once, the nearest first. Rows are ascending in ``a``'s times."""
    rows_a, rows_b = np.argsort(a, kind="stable"), np.argsort(b, kind="stable")
    found_a, found_b = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)]
    while len(rows_a) and len(rows_b):
        times_a, times_b = a[rows_a], b[rows_b]
        to_b, to_a = _nearest_rows(times_a, times_b), _nearest_rows(times_b, times_a)
        mutual = (to_a[to_b] == np.arange(len(times_a))) & (np.abs(times_b[to_b] - times_a) <= tolerance)
        if not mutual.any():
            break
        found_a.append(rows_a[mutual])
        found_b.append(rows_b[to_b[mutual]])
        rows_a, rows_b = rows_a[~mutual], np.delete(rows_b, to_b[mutual])
    pairs_a, pairs_b = np.concatenate(found_a), np.concatenate(found_b)
    order = np.argsort(a[pairs_a], kind="stable")
    return pairs_a[order], pairs_b[order]


def time_tolerance(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    """How much the times of two streams may differ, seconds: half the frame interval of the faster one, but no less
    than ``SAME_TIME_S``, and no more than that interval or ``FARTHEST_S``."""
    intervals = [float(np.median(np.diff(np.sort(times)))) for times in (a, b) if len(times) > 1]
    interval = min(intervals, default=2 * SAME_TIME_S)
    return min(max(SAME_TIME_S, 0.5 * interval), interval, FARTHEST_S)


@dataclass(frozen=True)
class _Pairs:
    first: tuple[int, ...] = ()
    second: tuple[int, ...] = ()
    column: Column | None = None
    tolerance_s: float | None = None

    def __len__(self) -> int:
        return len(self.first)


def _longest(found: Sequence[_Pairs]) -> _Pairs:
    return max(found, key=len, default=_Pairs())


def _alike(names: Sequence[str]) -> list[int]:
    """Rows of the names that have the form of most or, if forms vary, hold as many numbers as most do."""
    stems = [_stem(name) for name in names]
    forms = [_DIGITS.sub("#", stem) for stem in stems]
    if forms and Counter(forms).most_common(1)[0][1] < USUAL_FORM * len(forms):
        forms = [str(form.count("#")) for form in forms]
    usual = Counter(forms).most_common(1)[0][0] if forms else ""
    return [row for row, form in enumerate(forms) if form == usual]


def _stem(name: str) -> str:
    """The name without its suffix. Names are those of files, without folders."""
    return name.rpartition(".")[0] or name


def _numbers(stem: str) -> list[str]:
    return [number[-_MOST_DIGITS:] for number in _DIGITS.findall(stem)]


def _whole(stem: str, numbers: Sequence[str]) -> int:
    """A name as a number: that of its numbers or, without any, of its text. Sorts as the name does."""
    if numbers:
        return int("".join(number.zfill(_MOST_DIGITS) for number in numbers[:_MOST_NUMBERS]))
    return int.from_bytes(stem.encode(errors="surrogateescape")[:_LONGEST_NAME].ljust(_LONGEST_NAME, b"\0"))


def _decimals(stems: Sequence[str], digits: Sequence[Sequence[str]], place: int) -> Column | None:
    """Numbers ``place`` and the next as one decimal; None unless a point joins them in all names. Trailing zeros may be
    missing: .5 is .500000."""
    values = []
    for stem, numbers in zip(stems, digits, strict=True):
        whole, part = numbers[place], numbers[place + 1]
        if f"{whole}.{part}" not in stem:
            return None
        values.append(int(whole) * _NANO + int(part[:9].ljust(9, "0")))
    return Column(tuple(values), "decimal")


def _column(numbers: Sequence[str]) -> Column:
    lengths = set(map(len, numbers))
    return Column(tuple(map(int, numbers)), padded=lengths.pop() if len(lengths) == 1 else 0)


def _equal(a: Column, b: Column) -> _Pairs:
    rows = {value: row for row, value in enumerate(b.values)}
    found = [(row, rows[value]) for row, value in enumerate(a.values) if value in rows]
    return _Pairs(tuple(i for i, _ in found), tuple(j for _, j in found), a)


def _nearest(a: Column, b: Column) -> _Pairs:
    """Pairs by the nearest time, if both are times of one clock."""
    units = a.units_per_second()
    if units is None or a.epoch_units() != b.epoch_units():
        return _Pairs()
    start = min(*a.values, *b.values)
    own, other = a.floats(start) / units, b.floats(start) / units
    tolerance = time_tolerance(own, other)
    rows_a, rows_b = associate_nearest(own, other, tolerance)
    return _Pairs(tuple(rows_a.tolist()), tuple(rows_b.tolist()), a, tolerance)


def _nearest_rows(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.int64]:
    """For each of the ascending times ``a`` the row of the nearest of the ascending times ``b``."""
    after = np.clip(np.searchsorted(b, a), 0, len(b) - 1)
    before = np.maximum(after - 1, 0)
    return np.where(np.abs(b[before] - a) <= np.abs(b[after] - a), before, after)


def _shifted(a: Column, b: Column) -> _Pairs:
    """Files in order, if both folders count alike from another start."""
    if len(a.values) != len(b.values) or len(a.values) < 2:
        return _Pairs()
    rows_a, rows_b = (sorted(range(len(column.values)), key=column.values.__getitem__) for column in (a, b))
    offsets = {a.values[i] - b.values[j] for i, j in zip(rows_a, rows_b, strict=True)}
    return _Pairs(tuple(rows_a), tuple(rows_b), a) if len(offsets) == 1 else _Pairs()


def _in_order(pairs: _Pairs, columns: Sequence[Column]) -> Matches:
    """The pairs in the order of their numbers, with the times that the names state."""
    column = pairs.column
    if column is None:
        return Matches((), ())
    order = sorted(range(len(pairs)), key=lambda pair: column.values[pairs.first[pair]])
    first, second = (tuple(rows[pair] for pair in order) for rows in (pairs.first, pairs.second))
    units = column.units_per_second() if pairs.tolerance_s is not None else column.epoch_units()
    times = None if units is None else column.times(first, units)
    if times is None:
        times = next((found for other in columns if (found := _times_beside(other, column, first)) is not None), None)
    numbers = tuple(column.values[row] for row in first) if column.kind == "number" else ()
    return Matches(first, second, times, numbers, pairs.tolerance_s)


def _times_beside(other: Column, column: Column, rows: Sequence[int]) -> NDArray[np.float64] | None:
    """Seconds that names state beside their numbers, as Redwood's microseconds; None if they state none."""
    units = other.epoch_units() or (10**6 if other.padded >= _PADDED_MICROSECONDS else None)
    if other is column or other.kind == "name" or units is None:
        return None
    times = other.times(rows, units)
    return times if (np.diff(times) > 0).all() else None
