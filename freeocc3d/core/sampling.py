"""Chooses a few of many rows."""

from __future__ import annotations

import numpy as np


def spread_evenly(count: int, wanted: int) -> list[int]:
    """Up to ``wanted`` of ``count`` rows, ascending, evenly spread from the first to the last; empty without rows."""
    if count <= 0:
        return []
    return [int(row) for row in np.unique(np.linspace(0, count - 1, wanted).astype(int))]
