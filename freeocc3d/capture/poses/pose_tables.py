"""Reads tables of poses: TUM's and its relatives, with the columns that a heading names, and KITTI's matrices.

A heading may be a comment or a line of words: RTAB-Map's ``#timestamp x y z qx qy qz qw id``, EuRoC's ``#timestamp
[ns], p_RS_R_x [m], …, q_RS_w [], …``, Stray Scanner's ``timestamp, frame, x, y, z, qx, qy, qz, qw``. Without one, the
number of columns tells the form.

Sources: J. Sturm et al., A Benchmark for the Evaluation of RGB-D SLAM Systems, IROS 2012 (TUM); A. Geiger et al.,
KITTI's odometry development kit; M. Burri et al., The EuRoC micro aerial vehicle datasets, IJRR 2016; RTAB-Map's
"Export poses"; Stray Scanner's docs/format.md.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...core.tum_files import NUMBERS, compose_poses
from ..cameras.camera_files import FARTHEST
from ..files.number_files import NumberRows

MOST_POSES = 1_000_000
LATEST = 1e19
"""Largest time of a pose: nanoseconds of the year 2286."""

UNITS = (1.0, 1e-3, 1e-6, 1e-9)
"""Seconds per unit of time in files: seconds, milliseconds, microseconds, nanoseconds."""

SUPPORTED = f"TUM has {NUMBERS}, KITTI 12, Replica 16"

_POSE = ("x", "y", "z", "qw", "qx", "qy", "qz")
_MATRICES = (12, 16)
_SINCE_1970 = 1e9, 1e10
"""Seconds from 1970 to 2001 and to 2286; times in other units are 1000, 10^6 or 10^9 times as large."""

_UNIT_LENGTH = 0.9, 1.1
_SURELY_UNIT = 1e-2


_UNIT = r"(?:s|secs?|seconds?|[mun]s|[mun]secs?|(?:milli|micro|nano)s(?:econds?|ecs?)?)"
_TIME = re.compile(rf"(?:.*_)?(?:time|timestamps?|time_stamps?|stamp|t)(_?{_UNIT})?")
_FRAME = re.compile(r"(?:.*_)?(?:frame|id|index|idx|(?:frame|image|node|pose)_?(?:id|nr|no|number|num|index|idx))")
_QUATERNION = re.compile(r"q(?:_.*)?|(?:.*_)?(?:q|quat|quaternion|orientation|rot|rotation)")
_POSITION = re.compile(r"|p_.*|(?:.*_)?(?:t|p|pos|position|trans|translation|location)")
_SECONDS = {
    **dict.fromkeys(("", "sec", "second"), 1.0), **dict.fromkeys(("m", "msec", "millisec", "millisecond"), 1e-3),
    **dict.fromkeys(("u", "usec", "microsec", "microsecond"), 1e-6),
    **dict.fromkeys(("n", "nsec", "nanosec", "nanosecond"), 1e-9),
}  # fmt: skip
"""Seconds per unit, by the unit's name without a final s."""


class PoseTable(NamedTuple):
    """T_world_cam: (M, 4, 4), NaN where the file has none.  times: (M,) seconds, or None.  numbers: (M,) those of the
    frames, or None."""

    T_world_cam: NDArray[np.float64]
    times: NDArray[np.float64] | None = None
    numbers: NDArray[np.int64] | None = None


@dataclass(frozen=True)
class _Columns:
    """Where the columns stand. count: of all columns.  unit: of times, seconds; None = not stated."""

    places: dict[str, int]
    count: int
    unit: float | None = None


_TUM = _Columns({"time": 0, "x": 1, "y": 2, "z": 3, "qx": 4, "qy": 5, "qz": 6, "qw": 7}, NUMBERS)
_TUM_WITH_ID = _Columns({**_TUM.places, "frame": 8}, NUMBERS + 1)
_WITH_FRAME_SECOND = _Columns(
    {"time": 0, "frame": 1, "x": 2, "y": 3, "z": 4, "qx": 5, "qy": 6, "qz": 7, "qw": 8}, NUMBERS + 1
)


def read_pose_table(rows: NumberRows) -> PoseTable:
    """The poses of a table. Raises ValueError with the line and the reason, as part of a sentence."""
    if not len(rows.lengths):
        raise ValueError("it holds no numbers")
    columns = next((found for line in reversed(rows.headings) if (found := _name_columns(line))), None)
    if columns is not None:
        return _read_columns(rows, columns)
    if rows.lengths[0] == 3:
        return _read_log(rows)
    count = int(np.bincount(rows.lengths).argmax())
    if count in (NUMBERS, *_MATRICES):
        _check_lengths(rows, count, f"the others have {count}")
    else:
        _check_lengths(rows, count if count == NUMBERS + 1 else NUMBERS, SUPPORTED)
    if count in _MATRICES:
        T = np.tile(np.eye(4), (len(rows.lengths), 1, 1))
        T[:, : count // 4] = rows.values.reshape(len(T), -1, 4)
        return PoseTable(T)
    return _read_columns(rows, _TUM if count == NUMBERS else _guess_columns(rows))


def match_unit(times: NDArray[np.float64]) -> NDArray[np.float64]:
    """Times since 1970 as seconds, whatever their unit; others as they are."""
    middle = float(np.median(np.abs(times))) if len(times) else 0.0
    low, high = _SINCE_1970
    return times * next((unit for unit in UNITS if low <= middle * unit < high), 1.0)


def _check_lengths(rows: NumberRows, count: int, expected: str) -> None:
    odd = np.flatnonzero(rows.lengths != count)
    if len(odd):
        row = odd[0]
        raise ValueError(f"line {rows.lines[row]} has {rows.lengths[row]} numbers, {expected}")


def _name_columns(heading: str) -> _Columns | None:
    """The columns that a line of words names; None if it does not name a position and a quaternion."""
    text = re.sub(r"[\[(][^\])]{13,}[\])]?", "", heading.lstrip("#%/ \t"))  # remarks, not units
    text = re.sub(r"\s+(?=[\[(])", "", text)
    cells = re.split(r"\s*[,;\t]\s*", text.strip()) if re.search("[,;\t]", text) else text.split()
    places: dict[str, int] = {}
    unit = None
    for place, cell in enumerate(cells):
        name, stated = _understand(cell)
        if name and name not in places:
            places[name] = place
            unit = stated if name == "time" else unit
    return _Columns(places, len(cells), unit) if set(_POSE) <= places.keys() else None


def _understand(cell: str) -> tuple[str | None, float | None]:
    """What a column's name means: "time", "frame", one of ``_POSE``, or None; and the unit of a time, seconds."""
    name, _, unit = re.sub("[µμ]", "u", cell.lower()).partition("[" if "[" in cell else "(")
    name = "_".join(word for word in re.split(r"[^a-z0-9]+", name) if word)
    if match := _TIME.fullmatch(name):
        unit = (match[1] or unit).strip("_ ])")
        return "time", _SECONDS.get(unit.rstrip("s")) if unit else None
    if _FRAME.fullmatch(name):
        return "frame", None
    if (match := re.fullmatch(r"(.*?)_?([wxyz])", name)) is None:
        return None, None
    if _QUATERNION.fullmatch(match[1]):
        return f"q{match[2]}", None
    return (match[2] if match[2] != "w" and _POSITION.fullmatch(match[1]) else None), None


def _guess_columns(rows: NumberRows) -> _Columns:
    """The columns of TUM's form with one more, which holds whole numbers. Raises ValueError if it cannot be only so."""
    fitting = []
    for columns in (_TUM_WITH_ID, _WITH_FRAME_SECOND):
        frames = rows.column(columns.places["frame"])
        lengths = np.linalg.norm(_quats(rows, columns), axis=1)
        if (frames == np.round(frames)).all() and (np.isnan(lengths) | (np.abs(lengths - 1) < _SURELY_UNIT)).all():
            fitting.append(columns)
    if len(fitting) != 1:
        _check_lengths(rows, NUMBERS, SUPPORTED)
    return fitting[0]


def _quats(rows: NumberRows, columns: _Columns) -> NDArray[np.float64]:
    return np.stack([rows.column(columns.places[name]) for name in ("qw", "qx", "qy", "qz")], axis=1)


def _read_columns(rows: NumberRows, columns: _Columns) -> PoseTable:
    """Read a position and a quaternion per line. Raises ValueError."""
    needed = max(columns.places.values()) + 1
    for row in np.flatnonzero((rows.lengths < needed) | (rows.lengths > columns.count))[:1]:
        raise ValueError(f"line {rows.lines[row]} has {rows.lengths[row]} numbers, but its columns are {columns.count}")
    positions = np.stack([rows.column(columns.places[name]) for name in "xyz"], axis=1)
    quats_wxyz = _quats(rows, columns)
    times = rows.column(columns.places["time"]) if "time" in columns.places else None
    numbers = rows.column(columns.places["frame"]) if "frame" in columns.places else None
    finite: NDArray[np.bool_] = np.isfinite(np.column_stack((positions, quats_wxyz)))
    lost = np.asarray(~finite.any(axis=1))
    with np.errstate(over="ignore"):
        lengths = np.where(lost, 1.0, np.linalg.norm(quats_wxyz, axis=1))
    low, high = _UNIT_LENGTH
    _refuse(rows, ~lost & ~finite.all(axis=1), "holds a number that is not finite beside others that are")
    _refuse(rows, np.abs(np.where(lost[:, None], 0, positions)).max(axis=1) > FARTHEST, "is too far away")
    _refuse(rows, lengths == 0, "has a quaternion that is all zeros")
    _refuse(
        rows, ~((lengths > low) & (lengths < high)), "has a quaternion that is not of length 1: are these its columns?"
    )
    if times is not None:
        _refuse(rows, ~(np.abs(times) <= LATEST), "has no possible time")
        times = times * columns.unit if columns.unit else match_unit(times)
    if numbers is not None:
        _refuse(rows, ~((numbers >= 0) & (numbers <= 2**53) & (numbers == np.round(numbers))), "has no frame number")
    with np.errstate(invalid="ignore"):
        T = compose_poses(positions, quats_wxyz / lengths[:, None])
    T[lost] = np.nan
    return PoseTable(T, times, None if numbers is None else numbers.astype(np.int64))


def _refuse(rows: NumberRows, wrong: Any, reason: str) -> None:
    for row in np.flatnonzero(wrong)[:1]:
        raise ValueError(f"line {rows.lines[row]} {reason}")


def _read_log(rows: NumberRows) -> PoseTable:
    """Read Open3D's .log: per pose a line of three numbers, first the frame number, then four lines of the matrix."""
    count = -(-len(rows.lengths) // 5)
    wanted = np.tile((3, 4, 4, 4, 4), count)
    for row in np.flatnonzero(rows.lengths != wanted[: len(rows.lengths)])[:1]:
        raise ValueError(
            f"line {rows.lines[row]} has {rows.lengths[row]} numbers, where Open3D's .log has {wanted[row]}"
        )
    if len(rows.lengths) < 5 * count:
        raise ValueError(f"the matrix after line {rows.lines[5 * count - 5]} is cut off")
    blocks = rows.values.reshape(count, 3 + 16)
    numbers = blocks[:, 0]
    if not ((numbers >= 0) & (numbers < MOST_POSES)).all():
        raise ValueError("a frame number is out of range")
    T = np.full((int(numbers.max()) + 1, 4, 4), np.nan)
    T[numbers.astype(np.int64)] = blocks[:, 3:].reshape(count, 4, 4)
    return PoseTable(T)
