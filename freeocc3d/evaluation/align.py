"""The estimated trajectory against the true one: which poses belong together, and the best alignment of the two worlds.

Sources: S. Umeyama, PAMI 1991 (``geometry.umeyama``) on the camera centres of the frames that have a pose in both
(paper, "Coordinate System Alignment"); J. Sturm et al., A Benchmark for the Evaluation of RGB-D SLAM Systems, IROS
2012, for the association by time.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..capture import open_capture
from ..capture.base import Capture
from ..errors import CaptureError, FreeOccError, MapError
from ..geometry import is_rigid, umeyama
from ..store import read_tum
from ..types import Trajectory

ALIGNMENTS = ("se3", "sim3", "none")
"""Rigid, for trajectories with a metric scale; with a scale, for monocular ones; as they are."""

SAME_TIME_S = 0.02
"""Poses whose timestamps differ by no more belong together: the tolerance of the TUM RGB-D benchmark."""


@dataclass(frozen=True)
class Poses:
    """Poses of some frames: timestamps (M,) seconds and T_world_cam (M, 4, 4), all finite. They are kept in the order
    of time, in whatever order they are given."""

    timestamps: NDArray[np.float64]
    T_world_cam: NDArray[np.float64]

    def __post_init__(self) -> None:
        order = np.argsort(self.timestamps, kind="stable")
        object.__setattr__(self, "timestamps", self.timestamps[order])
        object.__setattr__(self, "T_world_cam", self.T_world_cam[order])

    def __len__(self) -> int:
        return len(self.timestamps)

    @property
    def centers(self) -> NDArray[np.float64]:
        """(M, 3) camera centres."""
        return self.T_world_cam[:, :3, 3]


@dataclass(frozen=True)
class Alignment:
    """The similarity that takes the estimate's world to the true one: x_true = scale * rotation @ x_est + translation.

    scale: 1 unless it was asked for.  rotation: (3, 3).  translation: (3,) metres.
    """

    scale: float
    rotation: NDArray[np.float64]
    translation: NDArray[np.float64]

    @staticmethod
    def identity() -> Alignment:
        """Both worlds are the same."""
        return Alignment(1.0, np.eye(3), np.zeros(3))

    def to_true(self, points_est: NDArray[np.floating]) -> NDArray[np.float64]:
        """(..., 3) points of the estimate's world in the true world."""
        return np.asarray(self.scale * points_est @ self.rotation.T + self.translation)

    def to_estimate(self, points_true: NDArray[np.floating]) -> NDArray[np.float64]:
        """(..., 3) points of the true world in the estimate's world: the inverse of ``to_true``."""
        return np.asarray((points_true - self.translation) @ self.rotation / self.scale)

    def poses(self, T_est_cam: NDArray[np.float64]) -> NDArray[np.float64]:
        """(..., 4, 4) camera poses of the estimate's world in the true world; rotations stay rotations."""
        T_true_cam = T_est_cam.copy()
        T_true_cam[..., :3, :3] = self.rotation @ T_est_cam[..., :3, :3]
        T_true_cam[..., :3, 3] = self.to_true(T_est_cam[..., :3, 3])
        return T_true_cam

    def to_json(self) -> dict[str, Any]:
        """``alignment`` of ``evaluate --json``."""
        return {
            "scale": self.scale,
            "rotation": self.rotation.tolist(),
            "translation": self.translation.tolist(),
        }


def align(estimated: Poses, true: Poses, how: str = "se3") -> Alignment:
    """The alignment of the camera centres of the frames that have a pose in both.

    Raises FreeOccError: fewer than three frames match, their centres lie on one line, unknown ``how``.
    """
    if how not in ALIGNMENTS:
        raise FreeOccError(f"Trajectories are aligned by {', '.join(ALIGNMENTS)}, not by '{how}'.")
    if how == "none":
        return Alignment.identity()
    rows_est, rows_true = associate(estimated.timestamps, true.timestamps)
    scale, R, t = umeyama(estimated.centers[rows_est], true.centers[rows_true], with_scale=how == "sim3")
    return Alignment(scale, np.asarray(R, np.float64), np.asarray(t, np.float64))


def associate(
    times_a: NDArray[np.float64], times_b: NDArray[np.float64], tolerance: float = SAME_TIME_S
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows of two ascending lists of timestamps that belong together: each of the shorter list with the nearest of the
    longer, where they differ by no more than the tolerance, in seconds."""
    if len(times_a) > len(times_b):
        rows_b, rows_a = associate(times_b, times_a, tolerance)
        return rows_a, rows_b
    if not len(times_a):
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    after = np.clip(np.searchsorted(times_b, times_a), 1, max(len(times_b) - 1, 1))
    before = after - 1
    after = np.minimum(after, len(times_b) - 1)
    nearest = np.where(np.abs(times_b[after] - times_a) < np.abs(times_b[before] - times_a), after, before)
    close = np.abs(times_b[nearest] - times_a) <= tolerance
    return np.flatnonzero(close), nearest[close]


def estimated_poses(trajectory: Trajectory) -> Poses:
    """The frames of a trajectory that have a pose."""
    rows = np.flatnonzero(trajectory.has_pose)
    return Poses(trajectory.timestamps[rows], trajectory.T_world_cam[rows])


def true_poses(capture: Capture) -> Poses:
    """The poses that a capture states. Raises FreeOccError if it has none at all."""
    stated = [(index, T) for index in range(len(capture)) if (T := capture.pose(index)) is not None]
    if not stated:
        raise FreeOccError(f"{capture.path} brings no poses to compare with: name a file of true poses with --poses.")
    rows, poses = zip(*stated, strict=True)
    return Poses(capture.timestamps[list(rows)], np.stack(poses))


def read_poses(path: str | Path) -> Poses:
    """Poses of a capture (its folder, or ``builtin:room``) or of a file: TUM's ``timestamp tx ty tz qx qy qz qw``, or
    12 or 16 numbers a line, the row-major camera-to-world matrix of frame 0, 1, … (KITTI, Replica), whose timestamp is
    the frame's index. Raises FreeOccError."""
    if str(path).startswith("builtin:") or Path(path).is_dir():
        return true_poses(open_capture(path))
    path = Path(path)
    if not path.is_file():
        raise FreeOccError(f"There is no file or capture {path} to take poses from.")
    try:
        columns = len(next(line for line in path.read_text().splitlines() if line.strip() and line[0] != "#").split())
        if columns in (12, 16):
            rows = np.loadtxt(path, ndmin=2).reshape(-1, columns // 4, 4)
            T = np.tile(np.eye(4), (len(rows), 1, 1))
            T[:, : columns // 4] = rows
            times = np.arange(len(T), dtype=np.float64)
        else:
            times, T = read_tum(path)
    except (OSError, ValueError, StopIteration, MapError) as error:
        raise FreeOccError(
            f"{path} is no trajectory: 8 numbers a line (TUM: timestamp, position, quaternion xyzw), or 12 or 16 (a "
            "matrix)."
        ) from error
    finite = np.isfinite(T).all(axis=(1, 2))
    if not all(is_rigid(pose) for pose in T[finite]):
        raise CaptureError(f"{path} holds a matrix that is no rigid camera-to-world pose.")
    return Poses(times[finite], T[finite])
