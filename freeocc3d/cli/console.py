"""What all commands share: arguments, and progress on stderr."""

from __future__ import annotations

import contextlib
import sys
import time
from pathlib import Path
from typing import Annotated, Any

import typer

from ..core.progress import Progress


def flag(name: str, help_text: str) -> Any:
    """A switch, for ``Annotated[bool, …]``. Its help shows no type."""
    return typer.Option(name, metavar="", help=help_text)


MapPath = Annotated[Path, typer.Argument(metavar="MAP", help="Map folder.")]
NewMap = Annotated[Path, typer.Option("-o", "--output", metavar="MAP", help="Map folder to write.")]
Json = Annotated[bool, flag("--json", "Print one JSON document and nothing else.")]
Set = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="Set one option; repeatable. See 'freeocc3d list'."),
]
Overwrite = Annotated[bool, flag("--overwrite", "Replace what exists.")]


def say(text: str, end: str = "\n") -> None:
    """Print to stderr. A log that is full or that nobody reads any more ends no work."""
    with contextlib.suppress(OSError):
        print(text, end=end, file=sys.stderr, flush=True)


class ConsoleProgress(Progress):
    """Progress on stderr: on a terminal one line that is redrawn, elsewhere a line per stage and warning. As a context
    manager, it always ends its line."""

    def __init__(self) -> None:
        self._name, self._total, self._start, self._drawn = "", None, 0.0, 0.0  # type: tuple[str, int | None, float, float]
        self._on_terminal = sys.stderr.isatty()

    def __enter__(self) -> ConsoleProgress:
        return self

    def __exit__(self, *raised: object) -> None:
        self.close()

    def stage(self, name: str, total: int | None = None) -> None:
        self.close()
        self._name, self._total, self._start = name, total, time.monotonic()
        if self._on_terminal:
            self._draw(0)

    def advance(self, done: int) -> None:
        if self._on_terminal and (done == self._total or time.monotonic() - self._drawn > 0.1):
            self._draw(done)

    def note(self, text: str) -> None:
        if text:
            self._clear()
            say(text)

    def warn(self, text: str) -> None:
        self._clear()
        say(f"warning: {text}")

    def close(self) -> None:
        """End the line of the current stage."""
        if self._name:
            self._clear()
            seconds = time.monotonic() - self._start
            steps = f", {self._total} steps" if self._total else ""
            say(f"{self._name}: {seconds:.1f} s{steps}")
        self._name = ""

    def _draw(self, done: int) -> None:
        self._drawn = time.monotonic()
        line = self._name
        if self._total:
            filled = 30 * done // self._total
            elapsed = self._drawn - self._start
            left = elapsed / done * (self._total - done) if done else 0.0
            line += f" [{'=' * filled}{' ' * (30 - filled)}] {done}/{self._total}, {left:.0f} s left"
        say(f"\r\x1b[K{line}", end="")

    def _clear(self) -> None:
        if self._on_terminal:
            say("\r\x1b[K", end="")
