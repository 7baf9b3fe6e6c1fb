"""Where the time of a whole run goes, against its floor, the decoding of the capture; and of a scan with more keyframes
than usual for its frames, for which every third frame of the capture stands."""

from __future__ import annotations

import json
import os
import resource
import tempfile
import time
from pathlib import Path

from .figures import Figures, Line
from .processes import COMMAND, run_inside, run_timed

STRIDES = {"every frame": 1, "every 3rd frame": 3}
_FRAMES_PER_SECOND = 25
"""The speed that the paper states, on another machine."""
_FITTING_SHARE, _PEAK_BYTES, _SPARSE_SECONDS = 1 / 3, 1.2e9, 50


def measure_budget(capture: str) -> Figures:
    """Seconds by stage of a run of the capture with default options, and seconds to decode its frames, one by one."""
    rows = {}
    with tempfile.TemporaryDirectory() as folder:
        for name, stride in STRIDES.items():
            out = str(Path(folder) / str(stride))
            before = resource.getrusage(resource.RUSAGE_CHILDREN)
            command = [*COMMAND, "reconstruct", capture, "-o", out, f"--set=capture.stride={stride}"]
            wall, peak_bytes, _ = run_timed(command)
            after = resource.getrusage(resource.RUSAGE_CHILDREN)
            facts = json.loads(run_timed([*COMMAND, "info", out, "--json"])[2])
            index = json.loads((Path(out) / "keyframes" / "keyframes.json").read_text(encoding="utf-8"))
            decoding = run_inside("budget:time_decoding", capture=capture, stride=stride)
            rows[name] = {
                "frames": facts["frames"] - facts["frame_status"].get("unused", 0),
                "keyframes": len(index),
                "wall_seconds": wall,
                "processor_seconds": after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime,
                "peak_memory_bytes": peak_bytes,
                "seconds": facts["seconds"],
                "decoding_seconds": decoding["decoding_seconds"],
            }
    return {"cores": len(os.sched_getaffinity(0)), "runs": rows}


def time_decoding(capture: str, stride: int) -> Figures:
    """Seconds to read and decode the used frames on one thread, and nothing else."""
    from freeocc3d.capture import open_capture

    opened = open_capture(capture)
    mark = time.perf_counter()
    for index in range(0, len(opened), stride):
        opened[index]
    return {"decoding_seconds": time.perf_counter() - mark}


def budget_lines(figures: Figures) -> list[Line]:
    """Rows of a table: what, measured, asked."""
    lines: list[Line] = []
    for name, row in figures["runs"].items():
        what, wall = f"{name} ({row['frames']} frames, {row['keyframes']} keyframes)", row["wall_seconds"]
        asked = "–" if name == "every frame" else f"≤ {_SPARSE_SECONDS}"
        own = sum(row["seconds"].values())
        decoding = row["decoding_seconds"]
        stages = ", ".join(f"{stage} {100 * seconds / own:.0f} %" for stage, seconds in row["seconds"].items())
        lines += [
            (f"{what}: seconds from start to end", f"{wall:.1f}", asked),
            (f"{what}: frames a second", f"{row['frames'] / wall:.1f}", f"{_FRAMES_PER_SECOND}"),
            (f"{what}: over decoding alone ({decoding:.1f} s)", f"{wall / decoding:.1f}", "–"),
            (f"{what}: processors at work", f"{row['processor_seconds'] / wall:.2f}", f"{figures['cores']}"),
            (f"{what}: fitting's share", f"{row['seconds'].get('fitting', 0) / own:.2f}", f"≤ {_FITTING_SHARE:.2f}"),
            (f"{what}: peak memory, GB", f"{1e-9 * row['peak_memory_bytes']:.2f}", f"≤ {1e-9 * _PEAK_BYTES:.1f}"),
            (f"{what}: stages", stages, "–"),
        ]
    return lines
