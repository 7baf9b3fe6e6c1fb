"""A part whose inputs end in all ways; the test of the harness runs it."""

from __future__ import annotations

import os
import random
import signal
import time
from pathlib import Path

from .harness import Attack, Silent


def _boom() -> None:
    raise ValueError("boom")


def _wrong() -> None:
    raise Silent("half of it")


def _leave(code: int, text: str) -> None:
    os.write(2, text.encode())
    raise SystemExit(code)


ENDS = {
    "returned": lambda: None,
    "refused": lambda: _leave(1, "freeocc3d: a sentence\n"),
    "traceback": _boom,
    "silent": _wrong,
    "traceback, printed": lambda: _leave(1, "Traceback (most recent call last):\n"),
    "traceback, exit without a word": lambda: _leave(1, ""),
    "crash": lambda: os.kill(os.getpid(), signal.SIGSEGV),
    "hang": lambda: time.sleep(60),
    "memory": lambda: bytearray(b"x") * (900 << 20),
}


def prepare(folder: Path) -> None:
    """Needs no originals."""


def attack(rng: random.Random, originals: Path, folder: Path) -> Attack:
    """The end with the number of the input."""
    name = list(ENDS)[int(folder.name.split("-")[0])]
    (folder / "locked").mkdir(0)
    os.mkfifo(folder / "pipe")
    return Attack(name, ENDS[name])
