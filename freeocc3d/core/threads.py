"""How many threads this process may run at the same time."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from pathlib import Path

_MOUNT = Path("/sys/fs/cgroup")


def count_threads() -> int:
    """Processors that this process may use, at least 1: those of its affinity, but no more than the CPU quota of its
    control groups, rounded up, as containers set it (``docker run --cpus``)."""
    allowed = len(os.sched_getaffinity(0))
    return max(1, min([allowed, *(math.ceil(quota) for quota in _quotas(Path("/proc/self/cgroup"), _MOUNT))]))


def _quotas(membership: Path, mount: Path) -> Iterator[float]:
    """Processors that each control group around this process allows, where it limits them.

    membership: lines of hierarchy:controllers:path (man 7 cgroups).  mount: where the hierarchies are mounted.
    """
    for line in (_read(membership) or "").splitlines():
        _, _, rest = line.partition(":")
        controllers, _, path = rest.partition(":")
        if controllers and "cpu" not in controllers.split(","):
            continue
        root = mount / controllers if controllers else mount
        own = root / path.lstrip("/")
        for group in (own, *(parent for parent in own.parents if parent.is_relative_to(root))):
            quota = _version_1(group) if controllers else _version_2(group)
            if quota is not None:
                yield quota


def _version_1(group: Path) -> float | None:
    quota, period = (_read(group / f"cpu.cfs_{name}_us") for name in ("quota", "period"))
    return int(quota) / int(period) if quota and period and int(quota) > 0 else None


def _version_2(group: Path) -> float | None:
    quota, _, period = (_read(group / "cpu.max") or "max").partition(" ")
    return int(quota) / int(period) if quota != "max" else None


def _read(path: Path) -> str | None:
    try:
        return path.read_text(encoding="ascii").strip()
    except OSError:
        return None
