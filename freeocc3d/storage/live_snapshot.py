"""What a run shows of a map while it makes it: a file in its work folder, written only while somebody watches.

Who watches keeps the file ``WATCHED`` fresh. The run looks at it now and then, and writes ``SNAPSHOT``.
"""

from __future__ import annotations

import contextlib
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.arrays import read_arrays, write_arrays
from ..core.errors import MapError

SNAPSHOT, WATCHED = "snapshot.npz", "watched"
_FRESH_S = 10.0
_MOST_BYTES = 1 << 30


@dataclass(frozen=True)
class Snapshot:
    """A map in the making.

    stage: what the run does, in words.  upright: whether the frame is the map's; else the tracker's.
    metric: whether lengths are meters; if not, their unit is unknown.
    T_view_map: (4, 4) to a frame with z up, as well as it is known.
    voxel_size: meters.  origin: (3,) lower corner of voxel (0, 0, 0), meters.
    voxels: (V, 3) int32 indices.  colors: (V, 3) uint8.
    path: (P, 3) float32 centers of the cameras so far.
    """

    stage: str
    upright: bool
    metric: bool
    T_view_map: NDArray[np.float64]
    voxel_size: float
    origin: NDArray[np.float64]
    voxels: NDArray[np.int32]
    colors: NDArray[np.uint8]
    path: NDArray[np.float32]


def write_snapshot(folder: Path, snapshot: Snapshot) -> None:
    """Replace the snapshot in a work folder. Raises OSError."""
    write_arrays(folder / SNAPSHOT, {name: np.array(value) for name, value in vars(snapshot).items()})


def read_snapshot(folder: Path) -> Snapshot | None:
    """Read the snapshot in a work folder; None if there is none. Raises MapError if it is damaged."""
    if not (folder / SNAPSHOT).is_file():
        return None
    expected: dict[str, Any] = {
        "stage": ("U", ()), "upright": ("b", ()), "metric": ("b", ()), "T_view_map": ("f", (4, 4)),
        "voxel_size": ("f", ()), "origin": ("f", (3,)), "voxels": ("i", (None, 3)),
        "colors": ("u", (None, 3)), "path": ("f", (None, 3)),
    }  # fmt: skip
    read: dict[str, Any] = read_arrays(folder / SNAPSHOT, expected, most_bytes=_MOST_BYTES)
    same = len(read["voxels"]) == len(read["colors"])
    if not (same and all(np.isfinite(array).all() for array in read.values() if array.dtype.kind == "f")):
        raise MapError(f"{folder / SNAPSHOT} is damaged: start 'freeocc3d view' again when the map is done.")
    return Snapshot(**{name: array if array.ndim else array.item() for name, array in read.items()})


def watch(folder: Path) -> None:
    """Tell the run in a work folder that somebody watches, for the next seconds."""
    with contextlib.suppress(OSError):
        (folder / WATCHED).write_bytes(b"")


def is_watched(folder: Path) -> bool:
    """Whether somebody watches the run in a work folder."""
    with contextlib.suppress(OSError):
        return time.time() - (folder / WATCHED).stat().st_mtime < _FRESH_S
    return False
