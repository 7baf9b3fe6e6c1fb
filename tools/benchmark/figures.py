"""Figures as JSON holds them, and the tables that show them."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any

Figures = dict[str, Any]
Line = tuple[str, str, str]
"""What was measured, the figure, and the goal."""


def tabulate(header: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """A Markdown table after an empty line; nothing if there are no rows."""
    lines = [header, ["---"] * len(header), *rows]
    return ["", *(f"| {' | '.join(line)} |" for line in lines)] if len(lines) > 2 else []


def tabulate_asked(lines: Iterable[Line]) -> list[str]:
    """A table of what was measured and its goal."""
    return tabulate(("what", "measured", "asked"), list(lines))


def format_number(value: float | None, factor: float, digits: int) -> str:
    """The value times the factor. A value that was not measured is a dash, never a zero."""
    return "–" if value is None or not math.isfinite(value) else f"{factor * value:.{digits}f}"
