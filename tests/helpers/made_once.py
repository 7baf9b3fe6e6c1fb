"""Files that take long to make: the first test process of a session makes them, and the others take them."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Callable
from pathlib import Path

import pytest


def make_once(factory: pytest.TempPathFactory, name: str, make: Callable[[Path], object]) -> Path:
    """The path at which ``make`` wrote a file or a folder in this session, in this process or in another one of
    pytest-xdist. No test changes it."""
    root = factory.getbasetemp()
    folder = (root.parent if "PYTEST_XDIST_WORKER" in os.environ else root) / "made_once"
    folder.mkdir(exist_ok=True)
    with (folder / f"{name}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not (folder / name).exists():
            make(folder / f"unfinished-{name}")
            os.replace(folder / f"unfinished-{name}", folder / name)
    return folder / name
