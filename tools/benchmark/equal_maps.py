"""Whether a map depends on the threads or on the cache of compiled kernels: it must not, to the byte."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

from .figures import Figures, Line
from .processes import COMMAND, run_timed

FRAMES = 40
_TIMED = {"report.json", "map.yaml"}
"""Files that hold times, or the checksum of one that does."""
WAYS: dict[str, dict[str, str]] = {
    "as it is": {},
    "one thread": {"OMP_NUM_THREADS": "1"},
    "an empty cache of kernels": {"NUMBA_CACHE_DIR": "EMPTY"},
    "that cache, now full": {"NUMBA_CACHE_DIR": "EMPTY"},
}


def measure_equal_maps(capture: str) -> Figures:
    """Maps of the first frames, made in each of WAYS: bytes of their files, and which files differ from the first."""
    with tempfile.TemporaryDirectory() as folder:
        made, rows = [], {}
        for number, (name, variables) in enumerate(WAYS.items()):
            path = Path(folder) / str(number)
            own = {key: folder if value == "EMPTY" else value for key, value in variables.items()}
            command = [*COMMAND, "reconstruct", capture, "-o", str(path), f"--set=capture.stop={FRAMES}"]
            seconds, _, _ = run_timed(command, {**os.environ, **own})
            made.append(_content(path))
            differing = [name for name in made[0].keys() | made[-1].keys() if made[0].get(name) != made[-1].get(name)]
            rows[name] = {"seconds": seconds, "bytes": sum(map(len, made[-1].values())), "differing": differing}
    return {"frames": FRAMES, "ways": rows}


def _content(folder: Path) -> dict[str, bytes]:
    files = (path for path in folder.rglob("*") if path.is_file() and path.name not in _TIMED)
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in files}


def equal_maps_lines(figures: Figures) -> list[Line]:
    """Rows of a table: what, measured, asked."""
    return [
        (f"map of {figures['frames']} frames, {name}", f"{row['bytes']:,} bytes, {len(row['differing'])} differ", "0")
        for name, row in figures["ways"].items()
    ]
