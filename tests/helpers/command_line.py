"""Runs the command line in a process of its own. That process is forked from one that has imported what most commands
need, and has done nothing else; a command that is started plainly takes up to three seconds to import it."""

from __future__ import annotations

import io
import multiprocessing
import os
import runpy
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

_VALUES = {
    "capture.stop": 8, "capture.color_focal": 1, "capture.synthetic.width": 160, "capture.synthetic.height": 120,
    "fitting.passes": 1,
}  # fmt: skip
SMALL = [word for name, value in _VALUES.items() for word in ("--set", f"{name}={value}")]
"""Options of ``reconstruct builtin:room`` for a map in a few seconds."""

_FORKING = multiprocessing.get_context("forkserver")
_FORKING.set_forkserver_preload(["freeocc3d.cli.main", "freeocc3d.pipeline.run", "freeocc3d.storage.writer"])
_LIMIT_S = 300


def run(
    *arguments: object, code: int = 0, lines: str = "", encoding: str | None = None
) -> subprocess.CompletedProcess[str]:
    """Run ``freeocc3d`` with ``lines`` as its input. encoding: of its streams; a plain process then."""
    given = [str(argument) for argument in arguments]
    done = _forked(given, lines) if encoding is None else _plain(given, lines, encoding)
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


def _forked(arguments: list[str], lines: str) -> subprocess.CompletedProcess[str]:
    with tempfile.TemporaryDirectory(prefix="command-") as folder:
        streams = [Path(folder, name) for name in ("in", "out", "err")]
        streams[0].write_text(lines, encoding="utf-8", errors="surrogateescape")
        process: Any = _FORKING.Process(
            target=_command, args=(arguments, streams, dict(os.environ), os.getcwd()), daemon=False
        )
        process.start()
        process.join(_LIMIT_S)
        if process.exitcode is None:
            process.kill()
            raise subprocess.TimeoutExpired(arguments, _LIMIT_S)
        out, err = (path.read_text(encoding="utf-8", errors="surrogateescape") for path in streams[1:])
        return subprocess.CompletedProcess(arguments, process.exitcode, out, err)


def _command(arguments: list[str], streams: list[Path], environment: dict[str, str], folder: str) -> None:
    """Become ``python -m freeocc3d.cli``."""
    os.chdir(folder)
    os.environ.clear()
    os.environ.update(environment)
    flags = (os.O_RDONLY, os.O_WRONLY | os.O_CREAT, os.O_WRONLY | os.O_CREAT)
    for number, (path, flag) in enumerate(zip(streams, flags, strict=True)):
        opened = os.open(path, flag)
        os.dup2(opened, number)
        os.close(opened)
    sys.stdin = io.TextIOWrapper(io.FileIO(0), encoding="utf-8", errors="surrogateescape")
    sys.stdout = io.TextIOWrapper(io.FileIO(1, "w"), encoding="utf-8", errors="surrogateescape")
    sys.stderr = io.TextIOWrapper(io.FileIO(2, "w"), encoding="utf-8", errors="backslashreplace", line_buffering=True)
    sys.argv = ["freeocc3d", *arguments]
    runpy.run_module("freeocc3d.cli", run_name="__main__")
