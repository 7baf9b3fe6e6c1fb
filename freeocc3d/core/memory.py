"""How much memory this process may still take."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from .control_groups import MEMBERSHIP, MOUNT, find_groups, read_line

_FILES = {1: ("memory.limit_in_bytes", "memory.usage_in_bytes"), 2: ("memory.max", "memory.current")}
"""Files with the limit and the use of a group, for each version of Linux's control groups."""
_UNKNOWN = 1 << 62


def available_memory() -> int:
    """Bytes that can be taken: those that the machine has free, and at most those that its containers leave. A very
    large number where neither is known."""
    return min([_free(), *_left(MEMBERSHIP, MOUNT)])


def _left(membership: Path, mount: Path) -> Iterator[int]:
    """Yield the bytes that each control group of this process leaves, if it sets a limit."""
    for folder, version in find_groups("memory", membership, mount):
        most, used = (_number(folder / name) for name in _FILES[version])
        if most is not None and used is not None:
            yield max(most - used, 0) + _reclaimable(folder)


def _free() -> int:
    try:
        lines = Path("/proc/meminfo").read_text(encoding="ascii").splitlines()
    except (OSError, UnicodeDecodeError):
        return _UNKNOWN
    found = [line.split()[1] for line in lines if line.startswith("MemAvailable:")]
    return int(found[0]) << 10 if found and found[0].isdecimal() else _UNKNOWN


def _reclaimable(folder: Path) -> int:
    """Bytes of files that a container keeps in memory and can drop."""
    try:
        lines = (folder / "memory.stat").read_text(encoding="ascii").splitlines()
    except (OSError, UnicodeDecodeError):
        return 0
    return sum(int(line.split()[1]) for line in lines if line.split()[0] in ("inactive_file", "total_inactive_file"))


def _number(path: Path) -> int | None:
    text = read_line(path) or ""
    return int(text) if text.isdecimal() else None
