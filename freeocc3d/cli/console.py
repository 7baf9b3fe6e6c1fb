"""What all commands share: arguments, answers on stdout, and progress on stderr. Nothing else here prints."""

from __future__ import annotations

import contextlib
import json
import sys
import time
from pathlib import Path
from typing import Annotated, Any

import typer

from ..core.errors import printable
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


def show(*lines: str) -> None:
    """Print lines to stdout. Names in them are of maps, captures and models from outside: what would move the cursor,
    break the line or turn the writing around becomes an escape, so that each argument is one line of the answer."""
    print("\n".join(map(printable, lines)), flush=True)


def show_document(document: Any) -> None:
    """Print plain values to stdout as one line of JSON, which holds each name exactly."""
    print(json.dumps(document), flush=True)


def say(line: str) -> None:
    """Print a line to stderr, as ``show`` does."""
    _write_to_log(f"{printable(line)}\n")


def ask_for_line() -> None:
    """Print a prompt to stderr."""
    _write_to_log("> ")


def _write_to_log(text: str) -> None:
    """A log that is full or that nobody reads any more ends no work."""
    with contextlib.suppress(OSError):
        print(text, end="", file=sys.stderr, flush=True)


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
        _write_to_log(f"\r\x1b[K{printable(line)}")

    def _clear(self) -> None:
        if self._on_terminal:
            _write_to_log("\r\x1b[K")
