"""Runs tools/benchmark.py as a user does."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

_ENTRY = Path(__file__).parents[2] / "tools" / "benchmark.py"


def run_benchmark(*arguments: object, code: int = 0) -> str:
    """What it prints to stdout; of a run that ends with another code, to stderr."""
    command = [sys.executable, str(_ENTRY), *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600)
    assert done.returncode == code, done.stderr
    return done.stdout if code == 0 else done.stderr
