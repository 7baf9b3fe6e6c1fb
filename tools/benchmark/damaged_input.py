"""How damaged inputs and killed runs end: the long run of tests/fuzz, counted."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections import Counter
from pathlib import Path

from .figures import Figures, Line
from .folders import REPOSITORY
from .processes import PartFailed

INPUTS, SEED = 10_000, 0
SOUND = ("returned", "refused")
UNSOUND = ("traceback", "crash", "hang", "memory", "silent")
_KINDS = {"while it gets its name": "call ", "kill -9": "killed at", "torn or flipped checkpoints": "stopped at"}
"""Kinds of the part "checkpoints", and what is in their descriptions; the first that fits counts."""


def measure_damaged_input(inputs: int = INPUTS, seed: int = SEED) -> Figures:
    """Ends of the inputs of every part; of killed runs and damaged checkpoints, how many give the same map or a
    sentence."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "results.json"
        run = [sys.executable, str(REPOSITORY / "tests" / "fuzz" / "run.py")]
        done = subprocess.run(
            [*run, "--inputs", str(inputs), "--seed", str(seed), "--json", str(path)], capture_output=True, text=True
        )
        if not path.is_file():
            raise PartFailed((done.stderr.strip().splitlines() or ["the run wrote no results"])[-1])
        results = json.loads(path.read_text(encoding="utf-8"))
    stopped: dict[str, Counter[str]] = {kind: Counter() for kind in _KINDS}
    for outcome, description in results["checkpoints"]:
        kind = next(kind for kind, said in _KINDS.items() if said in description)
        stopped[kind]["sound" if outcome in SOUND else "unsound"] += 1
    return {"seed": seed, "counts": results["counts"], "stopped": stopped, "failures": len(results["failures"])}


def damaged_input_lines(figures: Figures) -> list[Line]:
    """Rows of a table: what, measured, asked."""
    counts = {part: Counter(ends) for part, ends in figures["counts"].items()}
    total = sum(counts.values(), Counter())
    lines: list[Line] = [(f"damaged inputs, seed {figures['seed']}", f"{total.total():,}", "≥ 10,000")]
    lines += [(f"  {end}", f"{total[end]:,}", "0" if end in UNSOUND else "") for end in (*SOUND, *UNSOUND)]
    for part, ends in counts.items():
        failed = sum(ends[end] for end in UNSOUND)
        lines.append((f"  {part}: used or refused, failed", f"{ends.total() - failed:,}, {failed}", ""))
    asked = {"kill -9": "≥ 40 equal maps", "while it gets its name": "≥ 10 equal maps"}
    for kind, ends in figures["stopped"].items():
        equal = f"{ends.get('sound', 0)} of {sum(ends.values())} equal or told"
        lines.append((f"  {kind}", equal, asked.get(kind, "≥ 25, all")))
    return lines
