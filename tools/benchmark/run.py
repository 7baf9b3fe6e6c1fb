"""One run: rows of captures and variants, then the other measurements."""

from __future__ import annotations

import itertools
import os
import platform
import sys
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from .ablations import read_ablations
from .figures import Figures
from .folders import capture_name
from .job import Job
from .map_rows import measure_map
from .peer_rows import PEERS, measure_peer, run_dense_slam
from .processes import PartFailed, run_inside
from .registry import MEASUREMENTS, Measurement

LAYER_1_STAGES = ("calibration", "tracking", "refinement")
_TRACKED = ("stress", "glued", "lengths")
"""Measurements that time kernels which the first run would have to compile."""


def run(
    captures: Sequence[Path], names: Sequence[str], frames: int | None, folder: Path, before: Path | None = None
) -> Figures:
    """All rows, and the figures of all named measurements. before: a checkout of an earlier tree to compare with."""
    jobs = [Job(capture.resolve(), frames, folder / str(number)) for number, capture in enumerate(captures)]
    if any(name not in MEASUREMENTS or name in _TRACKED for name in names):
        first = str(jobs[0].capture)
        _try("nothing yet, all kernels compile first", lambda: run_inside("tracking_stress:warm_up", capture=first))
    rows: list[Figures] = []
    for job in jobs:
        job.folder.mkdir(parents=True)
        rows += _measure_rows(job, names)
    measured = {
        name: [row for given in _arguments_of(part, jobs, before) for row in _measure_part(name, part, given)]
        for name, part in MEASUREMENTS.items()
        if name in names
    }
    machine = {"processor": platform.machine(), "cores": os.cpu_count(), "python": platform.python_version()}
    return {"machine": machine, "frames": frames, "rows": rows, "measurements": measured}


def _measure_rows(job: Job, names: Sequence[str]) -> list[Figures]:
    """A capture's rows of ablations and peers."""
    known = read_ablations()
    slam = None
    if any(name.startswith("dense_slam") for name in names):
        slam = _try(f"{job.name}: dense SLAM", lambda: run_dense_slam(job))
    rows: list[Figures] = []
    for name in names:
        if name in known:
            variant = known[name]
            measure, title, table = partial(measure_map, job, variant), variant.title, variant.table
        elif name in PEERS:
            measure, title, table = partial(measure_peer, job, name, slam), PEERS[name], "Peers"
        else:
            continue
        row = _try(f"{job.name}: {name}", measure)
        if slam is not None and "error" not in slam:
            row |= _over_dense_slam(row, slam["seconds_without_decoding"])
        why = row.pop("error", "")
        facts = {"capture": job.name, "variant": name, "title": title, "table": table}
        rows.append({**facts, "available": not why, "why": why, **row})
    return rows


def _over_dense_slam(row: Figures, slam_seconds: float) -> Figures:
    """A row's seconds, and those of some of its stages, over dense SLAM's."""
    figures: Figures = {}
    if "wall_seconds" in row:
        figures["wall_over_dense_slam"] = row["wall_seconds"] / slam_seconds
    stages = {stage: 1e-3 * row["frames"] * value for stage, value in row.get("ms_per_frame", {}).items()}
    for what, of_what in (("layer_1", LAYER_1_STAGES), ("fitting", ("fitting",))):
        if own := sum(stages.get(stage, 0.0) for stage in of_what):
            figures[f"{what}_over_dense_slam"] = own / slam_seconds
    return figures


def _arguments_of(part: Measurement, jobs: Sequence[Job], before: Path | None) -> Iterator[dict[str, Any]]:
    """The arguments of a measurement in each of its processes, and "name", which its rows have as "capture"."""
    if part.given == "nothing":
        yield {"name": ""}
    elif part.given == "captures":
        for first, second in itertools.pairwise(job.capture for job in jobs):
            name = f"{capture_name(first)} + {capture_name(second)}"
            yield {"name": name, "captures": [str(first), str(second)]}
    elif part.given in ("capture", "earlier"):
        more = {"before": before and str(before)} if part.given == "earlier" else {}
        yield from ({"name": job.name, "capture": str(job.capture), **more} for job in jobs)
    else:
        yield from ({"name": job.name, "map_path": str(job.map(part.map_of))} for job in jobs)


def _measure_part(name: str, part: Measurement, given: dict[str, Any]) -> list[Figures]:
    """A process's rows: its figures, or those of each of its "cases"."""
    capture = given.pop("name")

    def measure() -> Figures:
        if "map_path" in given and not (Path(given["map_path"]) / "map.yaml").is_file():
            raise PartFailed(f"there is no map: also name the variant {part.map_of}")
        return run_inside(part.measure, **given)

    figures = _try(f"{capture}: {name}" if capture else name, measure)
    return [{"capture": capture, **case} for case in figures.get("cases", [figures])]


def _try(what: str, measure: Callable[[], Figures]) -> Figures:
    """The figures, or {"error": sentence}."""
    print(f"measuring: {what}", file=sys.stderr, flush=True)
    try:
        return dict(measure())
    except PartFailed as error:
        return {"error": str(error)}
