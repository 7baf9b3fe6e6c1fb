"""report.json: the run that made a map. What readers use has its type; other keys are kept as they are."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np

from ..core.errors import MapError
from ..core.regular_files import read_bytes
from ..core.typed_documents import InvalidDocument, as_type, parse_json

_MOST_BYTES = 256 << 20
_MOST = (1 << 63) - 1

_Count = Annotated[int, msgspec.Meta(ge=0, le=_MOST)]
_Status = Annotated[str, msgspec.Meta(max_length=12)]


class _Notice(msgspec.Struct):
    code: str
    text: str


class _Submap(msgspec.Struct):
    frames: _Count
    first: _Count
    last: _Count
    keyframes: _Count
    mapped: bool
    closures: list[tuple[_Count, _Count, bool]]


class _FrameLog(msgspec.Struct):
    timestamp: list[float]
    status: list[_Status]
    confidence: list[float]


class _Rendering(msgspec.Struct):
    psnr_measured: float | None = None
    depth_l1_m: float | None = None
    covered: float | None = None


class _Measure(msgspec.Struct):
    value: float | None
    unit: str
    count: _Count


class _Check(msgspec.Struct):
    verdict: Annotated[str, msgspec.Meta(max_length=12)]
    measures: dict[str, _Measure]


class _Relabeled(msgspec.Struct):
    map: str
    seconds: dict[str, float]


class _Report(msgspec.Struct):
    seconds: dict[str, float]
    peak_memory_bytes: _Count
    frames: dict[str, _Count]
    warnings: list[_Notice | str]
    frame_log: _FrameLog
    color_focal: Annotated[float, msgspec.Meta(gt=0)] = 1.0
    submaps: list[_Submap] = []
    rendering: _Rendering | None = None
    check: _Check | None = None
    relabeled: _Relabeled | None = None


def read_report(path: Path) -> dict[str, Any]:
    """The content of report.json, whose keys that any reader uses have their types. Raises MapError."""
    try:
        content = parse_json(read_bytes(path, _MOST_BYTES))
        problem = _problem(as_type(content, _Report))
    except OSError as error:
        raise MapError(f"Cannot read {path}: {error.strerror}.") from error
    except InvalidDocument as error:
        raise MapError(f"{path} is damaged: {error}.") from error
    if problem:
        raise MapError(f"{path} is damaged: {problem}.")
    return dict(content)


def _problem(report: _Report) -> str:
    log = report.frame_log
    if not len(log.timestamp) == len(log.status) == len(log.confidence):
        return "the lists of 'frame_log' have different lengths"
    for name, values in (
        ("frame_log.timestamp", log.timestamp),
        ("frame_log.confidence", log.confidence),
        ("seconds", list(report.seconds.values())),
        ("relabeled", list(report.relabeled.seconds.values()) if report.relabeled else []),
        ("color_focal", [report.color_focal]),
        ("rendering", msgspec.structs.astuple(report.rendering or _Rendering())),
        ("check", [measure.value for measure in (report.check.measures if report.check else {}).values()]),
    ):
        values = [value for value in values if value is not None]
        if not np.isfinite(np.array(values, np.float64)).all():
            return f"'{name}' holds a number that is not finite"
    return "" if 0.1 <= report.color_focal <= 10 else "'color_focal' is not between 0.1 and 10"
