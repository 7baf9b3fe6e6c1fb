"""Measurements in their own processes, with their own threads, memory peak and imports."""

from __future__ import annotations

import importlib
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from typing import Any

from .figures import Figures
from .folders import REPOSITORY

COMMAND = [sys.executable, "-m", "freeocc3d.cli"]
_ENTRY = REPOSITORY / "tools" / "benchmark.py"


class PartFailed(Exception):
    """A part could not be measured; the message is one sentence."""


def run_timed(command: list[str], environment: Mapping[str, str] | None = None) -> tuple[float, int, str]:
    """Wall seconds, peak resident bytes (of the largest of its processes) and stdout of a command.

    A process begins with the peak of the process that starts it, which must therefore be small. environment: None =
    this process's. Raises PartFailed with the command's last line on stderr.
    """
    with tempfile.TemporaryFile("w+") as out, tempfile.TemporaryFile("w+") as err:
        mark = time.perf_counter()
        process = subprocess.Popen(command, stdout=out, stderr=err, env=environment)
        _, status, usage = os.wait4(process.pid, 0)
        seconds = time.perf_counter() - mark
        process.returncode = os.waitstatus_to_exitcode(status)
        out.seek(0)
        err.seek(0)
        if process.returncode != 0:
            said = err.read().strip().splitlines() or [f"it ended with {process.returncode}"]
            raise PartFailed(said[-1].removeprefix("freeocc3d: "))
        return seconds, usage.ru_maxrss * 1024, out.read()


def run_inside(function: str, **arguments: Any) -> Figures:
    """``module:function`` of this package in a fresh interpreter, with its peak memory. Raises PartFailed."""
    _, peak_bytes, printed = run_timed([sys.executable, str(_ENTRY), "--inside", function, json.dumps(arguments)])
    figures: Figures = json.loads(printed.splitlines()[-1])  # libraries print to stdout too
    return {**figures, "peak_memory_bytes": peak_bytes}


def find_function(function: str) -> Any:
    """The function ``module:function`` of this package."""
    module, _, name = function.partition(":")
    return getattr(importlib.import_module(f"{__package__}.{module}"), name)


def answer_inside(function: str, arguments: str) -> None:
    """The other side of ``run_inside``."""
    try:
        print(json.dumps(find_function(function)(**json.loads(arguments))))
    except PartFailed as error:
        raise SystemExit(str(error)) from None
