"""Runs the command line as ``freeocc3d`` does, in the process of the tests: one of its own takes seconds to import what
a command needs, and to load compiled kernels."""

from __future__ import annotations

import io
import os
import subprocess
import sys

from freeocc3d.cli.main import main

_VALUES = {
    "capture.stop": 8, "capture.color_focal": 1, "capture.synthetic.width": 160, "capture.synthetic.height": 120,
    "fitting.passes": 1,
}  # fmt: skip
SMALL = [word for name, value in _VALUES.items() for word in ("--set", f"{name}={value}")]
"""Options of ``reconstruct builtin:room`` for a map in a few seconds."""

_LIMIT_S = 300


def run(
    *arguments: object, code: int = 0, lines: str = "", encoding: str | None = None
) -> subprocess.CompletedProcess[str]:
    """Run ``freeocc3d`` with ``lines`` as its input. encoding: of its streams, in a process of its own then."""
    given = [str(argument) for argument in arguments]
    done = _inside(given, lines) if encoding is None else _plain(given, lines, encoding)
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


def _plain(arguments: list[str], lines: str, encoding: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "freeocc3d.cli", *arguments],
        input=lines,
        capture_output=True,
        text=True,
        errors="surrogateescape",
        timeout=_LIMIT_S,
        env=os.environ | {"PYTHONIOENCODING": encoding},
    )


def _inside(arguments: list[str], lines: str) -> subprocess.CompletedProcess[str]:
    made = [io.TextIOWrapper(io.BytesIO(), encoding="utf-8", errors="surrogateescape") for _ in range(3)]
    made[0].write(lines)
    made[0].seek(0)
    before = sys.stdin, sys.stdout, sys.stderr
    sys.stdin, sys.stdout, sys.stderr = made
    code: object = 0
    try:
        main(arguments)
    except SystemExit as end:
        code = end.code or 0
    finally:
        sys.stdin, sys.stdout, sys.stderr = before
    for stream in made[1:]:
        stream.flush()
        stream.seek(0)
    assert isinstance(code, int)
    return subprocess.CompletedProcess(arguments, code, made[1].read(), made[2].read())
