"""Reads and writes trajectories in the format of the TUM RGB-D benchmark. Each line is one camera-to-world pose:
``timestamp tx ty tz qx qy qz qw``.

Source: J. Sturm et al., A Benchmark for the Evaluation of RGB-D SLAM Systems, IROS 2012.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from .regular_files import read_text
from .transforms import quats_to_rotations, rotations_to_quats
from .types import Trajectory

NUMBERS = 8
"""Numbers per line."""

_FARTHEST, _LONGEST_WORD = 1e9, 64

_HEADER = "# timestamp tx ty tz qx qy qz qw (camera to world, OpenCV axes, metres, seconds)"
"""Spelled as in every earlier map, so that equal trajectories give equal files."""


def write_tum(path: Path, trajectory: Trajectory) -> None:
    """Write the frames that have a pose. Raises OSError."""
    rows = np.flatnonzero(trajectory.has_pose)
    T = trajectory.T_world_cam[rows]
    quats_wxyz = rotations_to_quats(T[:, :3, :3])
    lines = [_HEADER]
    for time, t, (w, x, y, z) in zip(
        trajectory.timestamps[rows].tolist(), T[:, :3, 3].tolist(), quats_wxyz.tolist(), strict=True
    ):
        lines.append(f"{time!r} {t[0]:.9f} {t[1]:.9f} {t[2]:.9f} {x:.9f} {y:.9f} {z:.9f} {w:.9f}")
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def read_tum(path: Path) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Read (M,) timestamps and (M, 4, 4) poses. Raises OSError, or ValueError that says what is wrong."""
    lines = [line.split() for line in read_text(path).splitlines()]
    rows = [line for line in lines if line and not line[0].startswith("#")]
    return tum_poses(rows)


def tum_poses(rows: Sequence[Sequence[str]] | NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(M,) timestamps and (M, 4, 4) poses from M lines of words or numbers. Raises ValueError that says what is
    wrong."""
    for number, row in enumerate(rows, 1):
        if len(row) != NUMBERS:
            raise ValueError(f"pose {number} does not hold {NUMBERS} numbers, but {len(row)}")
    if not isinstance(rows, np.ndarray) and any(len(word) > _LONGEST_WORD for row in rows for word in row):
        raise ValueError("a word is too long for a number")
    table = np.array(rows, np.float64).reshape(-1, NUMBERS)
    if not (np.isfinite(table).all() and (np.abs(table[:, 1:]) <= _FARTHEST).all()):
        raise ValueError("a number is not finite, or a place is too far away")
    quats_wxyz = table[:, [7, 4, 5, 6]]
    lengths = np.linalg.norm(quats_wxyz, axis=1, keepdims=True)
    if (lengths == 0).any():
        raise ValueError("a quaternion is all zeros")
    return table[:, 0], compose_poses(table[:, 1:4], quats_wxyz / lengths)


def compose_poses(positions: NDArray[np.float64], quats_wxyz: NDArray[np.float64]) -> NDArray[np.float64]:
    """(M, 4, 4) poses of (M, 3) positions and (M, 4) unit quaternions."""
    T = np.tile(np.eye(4), (len(positions), 1, 1))
    T[:, :3, 3] = positions
    T[:, :3, :3] = quats_to_rotations(quats_wxyz)
    return T
