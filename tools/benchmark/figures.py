"""Figures as JSON holds them, and the tables that show them."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any

Figures = dict[str, Any]
Line = tuple[str, str, str]
"""What was measured, the figure, and what is asked for."""


def tabulate(header: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """A Markdown table after an empty line; nothing of no rows."""
    lines = [header, ["---"] * len(header), *rows]
    return ["", *(f"| {' | '.join(line)} |" for line in lines)] if len(lines) > 2 else []


def tabulate_asked(lines: Iterable[Line]) -> list[str]:
    """A table of what was measured beside what is asked for."""
    return tabulate(("what", "measured", "asked"), list(lines))


def format_number(value: float | None, factor: float, digits: int) -> str:
    """The value times the factor; what was not measured is a dash, never a zero."""
    return "–" if value is None or not math.isfinite(value) else f"{factor * value:.{digits}f}"
