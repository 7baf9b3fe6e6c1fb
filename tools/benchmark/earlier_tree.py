"""Processor and wall time of this tree over those of an earlier one, in pairs of processes of one run."""

from __future__ import annotations

import os
import resource
import statistics
import tempfile
from pathlib import Path

from .figures import Figures, Line
from .folders import REPOSITORY
from .processes import COMMAND, PartFailed, run_timed

FRAMES = 200
PAIRS = {"reconstruct": 4, "cold query": 25}
_MOST = 1.02


def measure_earlier_tree(capture: str, before: str | None) -> Figures:
    """Median seconds of each command by each tree. Both trees query the map of their own; the first run of each, which
    compiles, does not count.

    before: a checkout of the earlier tree, whose packages this environment has."""
    if before is None:
        raise PartFailed("it compares with an earlier tree: name a checkout with --before")
    trees = {"now": str(REPOSITORY), "before": str(Path(before).resolve())}
    rows: dict[str, dict[str, dict[str, float]]] = {}
    with tempfile.TemporaryDirectory() as folder:
        mapped = {tree: str(Path(folder) / tree) for tree in trees}
        stop = f"--set=capture.stop={FRAMES}"
        commands = {
            "reconstruct": {tree: ["reconstruct", capture, "-o", mapped[tree], "--overwrite", stop] for tree in trees},
            "cold query": {tree: ["query", mapped[tree], "red"] for tree in trees},
        }
        for name, own in commands.items():
            times: dict[str, list[tuple[float, float]]] = {tree: [] for tree in trees}
            for pair in range(PAIRS[name] + 1):
                for tree in list(trees)[:: 1 if pair % 2 else -1]:
                    times[tree].append(_timed([*COMMAND, *own[tree]], trees[tree]))
            rows[name] = {
                what: {tree: statistics.median(time[n] for time in times[tree][1:]) for tree in trees}
                for n, what in enumerate(("wall", "processor"))
            }
    return {"frames": FRAMES, "pairs": PAIRS, "seconds": rows}


def _timed(command: list[str], tree: str) -> tuple[float, float]:
    """Wall and processor seconds. The tree of the current folder would come before PYTHONPATH, but for SAFEPATH."""
    start = resource.getrusage(resource.RUSAGE_CHILDREN)
    wall, _, _ = run_timed(command, {**os.environ, "PYTHONPATH": tree, "PYTHONSAFEPATH": "1"})
    end = resource.getrusage(resource.RUSAGE_CHILDREN)
    return wall, end.ru_utime + end.ru_stime - start.ru_utime - start.ru_stime


def earlier_tree_lines(figures: Figures) -> list[Line]:
    """Rows of a table: what, measured, asked."""
    lines: list[Line] = []
    for name, kinds in figures["seconds"].items():
        for what, seconds in kinds.items():
            measured = (
                f"{seconds['now'] / seconds['before']:.3f} ({seconds['now']:.2f} s over {seconds['before']:.2f} s)"
            )
            lines.append((f"{name}, {what} time over the earlier tree's", measured, f"≤ {_MOST}"))
    return lines
