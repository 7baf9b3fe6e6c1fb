"""Times steps, in seconds."""

from __future__ import annotations

import time
from collections.abc import Callable

Seconds = dict[str, float]


def start_steps(*steps: str) -> Seconds:
    """Zero seconds for each step."""
    return dict.fromkeys(steps, 0.0)


def lap(seconds: Seconds, step: str, mark: float) -> float:
    """Add the time since the mark to a step. Returns the mark of the next step."""
    now = time.perf_counter()
    seconds[step] += now - mark
    return now


def time_fastest(work: Callable[[], object], repeats: int = 5) -> float:
    """Seconds of the fastest run."""
    times = []
    for _ in range(repeats):
        mark = time.perf_counter()
        work()
        times.append(time.perf_counter() - mark)
    return min(times)
