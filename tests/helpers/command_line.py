"""Runs the command line in a process of its own."""

from __future__ import annotations

import os
import subprocess
import sys

SMALL = ["--set", "capture.stop=8", "--set", "capture.synthetic.width=160", "--set", "capture.synthetic.height=120"]
"""Options of ``reconstruct builtin:room`` for a map in a few seconds."""


def run(
    *arguments: object, code: int = 0, lines: str = "", encoding: str | None = None
) -> subprocess.CompletedProcess[str]:
    done = subprocess.run(
        [sys.executable, "-m", "freeocc3d.cli", *map(str, arguments)],
        input=lines,
        capture_output=True,
        text=True,
        errors="surrogateescape",
        timeout=300,
        env=os.environ | ({"PYTHONIOENCODING": encoding} if encoding else {}),
    )
    assert done.returncode == code, done.stderr
    assert "Traceback" not in done.stderr
    return done


def refused(*arguments: object) -> str:
    """The one line on stderr with which a command is refused."""
    done = run(*arguments, code=1)
    lines = [line for line in done.stderr.splitlines() if line.startswith("freeocc3d: ")]
    assert len(lines) == 1, done.stderr
    assert done.stdout == ""
    return lines[0]
