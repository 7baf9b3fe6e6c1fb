"""What compiling costs a first run: of a package with kernels that were compiled ahead of time, and of one without."""

from __future__ import annotations

import os
import tempfile

from .figures import Figures, Line
from .processes import COMMAND, run_inside, run_timed

_FRAMES = 20
_MOST_SECONDS = 10


def measure_first_run() -> Figures:
    """Seconds of a small demo with an empty folder for kernels, and again with those that it left there; with kernels
    compiled ahead of time, and without any."""
    host = run_inside("first_run:name_processor")["processor"]
    seconds = {}
    for name, added in {"ahead": {}, "none": {"NUMBA_CPU_NAME": host}}.items():
        with tempfile.TemporaryDirectory() as folder:
            environment = os.environ | added | {"NUMBA_CACHE_DIR": folder}
            command = [*COMMAND, "demo", f"--frames={_FRAMES}", f"--output={folder}/demo", "--overwrite"]
            seconds[name] = [run_timed(command, environment)[0] for _ in range(3)]
    return {"seconds": seconds}


def name_processor() -> Figures:
    """LLVM's name of this processor. Kernels compiled ahead of time are not used if it is asked for."""
    from llvmlite import binding

    return {"processor": binding.get_host_cpu_name()}


def first_run_lines(figures: Figures) -> list[Line]:
    """Rows of a table: what, measured, asked."""
    lines: list[Line] = []
    for name, (first, *later) in figures["seconds"].items():
        warm = min(later)
        what = "kernels compiled ahead of time" if name == "ahead" else "no compiled kernels"
        asked = f"≤ {_MOST_SECONDS}" if name == "ahead" else "–"
        lines += [
            (f"{what}: seconds of a first run over a later one ({warm:.1f} s)", f"{first - warm:.1f}", asked),
            (f"{what}: first over later", f"{first / warm:.2f}", "–"),
        ]
    return lines
