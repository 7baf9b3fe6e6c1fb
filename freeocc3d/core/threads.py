"""Counts the processors that this process may use, and makes all libraries keep to them."""

from __future__ import annotations

import contextlib
import math
import os
from collections.abc import Iterator
from pathlib import Path

from .control_groups import MEMBERSHIP, MOUNT, find_groups, read_line

_POOLS = (
    "OMP_NUM_THREADS",  # torch, Open3D
    "NUMBA_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "OPENCV_FOR_THREADS_NUM",
    "VTK_SMP_MAX_THREADS",
)


def count_threads() -> int:
    """Number of processors that this process may use, at least 1: those of its affinity, limited by the CPU quota of
    its control groups, rounded up, and by ``$OMP_NUM_THREADS``. Containers set the quota (``docker run --cpus``)."""
    quotas = (math.ceil(quota) for quota in _quotas(MEMBERSHIP, MOUNT))
    return max(1, min([len(os.sched_getaffinity(0)), *quotas, *_wish()]))


def limit_pools() -> None:
    """Tell libraries that are imported later the number of threads, where it is less than the number of processors, and
    that threads of OpenMP sleep while they wait: they would take the time of those that read ahead and save."""
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    threads = count_threads()
    if threads < len(os.sched_getaffinity(0)):
        for name in _POOLS:
            os.environ.setdefault(name, str(threads))


def _wish() -> Iterator[int]:
    wish = os.environ.get("OMP_NUM_THREADS", "").split(",")[0].strip()
    if wish.isdecimal() and int(wish[:9]) > 0:
        yield int(wish[:9])


def _quotas(membership: Path, mount: Path) -> Iterator[float]:
    """Yield the number of processors that each control group of this process allows, if it sets a limit."""
    for group in find_groups("cpu", membership, mount):
        with contextlib.suppress(ValueError, ZeroDivisionError):  # not the file that Linux writes
            quota = _version_1(group.folder) if group.version == 1 else _version_2(group.folder)
            if quota is not None:
                yield quota


def _version_1(group: Path) -> float | None:
    quota, period = (read_line(group / f"cpu.cfs_{name}_us") for name in ("quota", "period"))
    return int(quota) / int(period) if quota and period and int(quota) > 0 else None


def _version_2(group: Path) -> float | None:
    quota, _, period = (read_line(group / "cpu.max") or "max").partition(" ")
    return int(quota) / int(period) if quota != "max" else None
