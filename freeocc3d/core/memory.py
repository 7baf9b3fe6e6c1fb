"""How much memory this process may still take."""

from __future__ import annotations

from pathlib import Path

_CGROUPS = (
    (Path("/sys/fs/cgroup/memory.max"), Path("/sys/fs/cgroup/memory.current")),
    (Path("/sys/fs/cgroup/memory/memory.limit_in_bytes"), Path("/sys/fs/cgroup/memory/memory.usage_in_bytes")),
)
"""Limit and use of a container, of version 2 and 1 of Linux's control groups."""
_UNKNOWN = 1 << 62


def available_memory() -> int:
    """Bytes that can be taken: those that the machine has free, and at most those that its container leaves. A very
    large number where neither is known."""
    available = _free()
    for limit, current in _CGROUPS:
        most, used = _number(limit), _number(current)
        if most is not None and used is not None:
            available = min(available, max(most - used, 0) + _reclaimable(limit.parent))
    return available


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
    try:
        text = path.read_text(encoding="ascii").strip()
    except (OSError, UnicodeDecodeError):
        return None
    return int(text) if text.isdecimal() else None
