"""Seconds of queries, from a cold start and in a loaded map."""

from __future__ import annotations

import statistics
import time

from .figures import Figures, Line
from .processes import COMMAND, run_timed

QUERY_WORD = "red"
COLD_STARTS = 5


def measure_query(map_path: str) -> Figures:
    """Seconds of a process that answers a word; of loading a map and its first answer; and the median of later
    answers."""
    command = [*COMMAND, "query", map_path, QUERY_WORD, "--json"]
    cold = statistics.median(run_timed(command)[0] for _ in range(COLD_STARTS))  # before this process imports anything
    from freeocc3d.query.scan_map import load_map

    mark = time.perf_counter()
    loaded = load_map(map_path)
    result = loaded.query(QUERY_WORD)
    first = time.perf_counter() - mark
    times = []
    for _ in range(20):
        mark = time.perf_counter()
        loaded.query(QUERY_WORD)
        times.append(time.perf_counter() - mark)
    return {
        "cold_seconds": cold,
        "first_seconds": first,
        "loaded_seconds": statistics.median(times),
        "regions": len(result.regions),
    }


def query_lines(figures: Figures) -> list[Line]:
    """Rows of a table: what, measured, asked."""
    return [
        ("query from a cold start", f"{figures['cold_seconds']:.2f} s", "≤ 1.5 s"),
        ("query in a loaded map", f"{1e3 * figures['loaded_seconds']:.1f} ms", "≤ 30 ms"),
        ("  loading with the first answer", f"{figures['first_seconds']:.2f} s", ""),
    ]
