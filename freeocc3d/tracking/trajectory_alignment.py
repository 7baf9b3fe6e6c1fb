"""Aligns an estimated trajectory with the true one: matches their poses and finds the best transform between them.

Sources: S. Umeyama, PAMI 1991 (``core.transforms.umeyama``), on the camera centers of the frames with a pose in both
(paper, "Coordinate System Alignment"); J. Sturm et al., A Benchmark for the Evaluation of RGB-D SLAM Systems, IROS
2012, for the association by time.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..capture import associate, open_capture, read_trajectory
from ..capture.base import Capture
from ..core.errors import CaptureError, FreeOccError
from ..core.transforms import umeyama
from ..core.types import Trajectory

ALIGNMENTS = ("se3", "sim3", "none")
"""Rigid, for metric trajectories; similarity, for monocular ones; unchanged."""


@dataclass(frozen=True)
class Poses:
    """Poses of some frames: timestamps (M,) seconds and T_world_cam (M, 4, 4), all finite. They are sorted by time."""

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
        """(M, 3) camera centers."""
        return self.T_world_cam[:, :3, 3]


@dataclass(frozen=True)
class TrajectoryAlignment:
    """The similarity from the estimated world to the true one: x_true = scale * rotation @ x_est + translation.

    scale: 1 unless it is estimated.  rotation: (3, 3).  translation: (3,) meters.
    """

    scale: float
    rotation: NDArray[np.float64]
    translation: NDArray[np.float64]

    @staticmethod
    def identity() -> TrajectoryAlignment:
        """The alignment of two equal worlds."""
        return TrajectoryAlignment(1.0, np.eye(3), np.zeros(3))

    def to_true(self, points_est: NDArray[np.floating]) -> NDArray[np.float64]:
        """Transform (..., 3) points from the estimated to the true world."""
        return np.asarray(self.scale * points_est @ self.rotation.T + self.translation)

    def to_estimate(self, points_true: NDArray[np.floating]) -> NDArray[np.float64]:
        """Transform (..., 3) points from the true to the estimated world: the inverse of ``to_true``."""
        return np.asarray((points_true - self.translation) @ self.rotation / self.scale)

    def poses(self, T_est_cam: NDArray[np.float64]) -> NDArray[np.float64]:
        """Transform (..., 4, 4) camera poses from the estimated to the true world; the scale changes positions only."""
        T_true_cam = T_est_cam.copy()
        T_true_cam[..., :3, :3] = self.rotation @ T_est_cam[..., :3, :3]
        T_true_cam[..., :3, 3] = self.to_true(T_est_cam[..., :3, 3])
        return T_true_cam

    def as_dict(self) -> dict[str, Any]:
        """The alignment as plain values."""
        return {
            "scale": self.scale,
            "rotation": self.rotation.tolist(),
            "translation": self.translation.tolist(),
        }


def align_trajectories(estimated: Poses, true: Poses, how: str = "se3") -> TrajectoryAlignment:
    """Align the camera centers of the frames with a pose in both.

    Raises FreeOccError: fewer than three frames match, their centers lie on one line, or ``how`` is unknown.
    """
    if how not in ALIGNMENTS:
        raise FreeOccError(f"An alignment is one of {', '.join(ALIGNMENTS)}, not '{how}'.")
    if how == "none":
        return TrajectoryAlignment.identity()
    rows_est, rows_true = associate(estimated.timestamps, true.timestamps)
    scale, R, t = umeyama(estimated.centers[rows_est], true.centers[rows_true], with_scale=how == "sim3")
    return TrajectoryAlignment(scale, np.asarray(R, np.float64), np.asarray(t, np.float64))


def select_estimated_poses(trajectory: Trajectory) -> Poses:
    """The poses of a trajectory, without frames that have none."""
    rows = np.flatnonzero(trajectory.has_pose)
    return Poses(trajectory.timestamps[rows], trajectory.T_world_cam[rows])


def read_true_poses(capture: Capture) -> Poses:
    """The poses that a capture states. Raises FreeOccError if it states none."""
    stated = [(index, T) for index in range(len(capture)) if (T := capture.pose(index)) is not None]
    if not stated:
        raise FreeOccError(f"{capture.path} states no poses to compare with: give a file of true poses with --poses.")
    rows, poses = zip(*stated, strict=True)
    return Poses(capture.timestamps[list(rows)], np.stack(poses))


def read_poses(path: str | Path) -> Poses:
    """Read the poses of a capture (a folder, or ``builtin:room``), or a file in any format of
    ``capture.read_trajectory``. Without times, frames are counted. Raises FreeOccError."""
    if str(path).startswith("builtin:"):
        return read_true_poses(open_capture(path))
    if not Path(path).exists():
        raise FreeOccError(f"There is no file or capture {path} with poses: check the path.")
    if Path(path).is_dir():
        try:
            capture = open_capture(path)
            if capture.metric_poses:
                return read_true_poses(capture)
        except CaptureError as no_capture:
            try:
                found = read_trajectory(path)
            except CaptureError:
                raise no_capture from None
        else:  # a reconstruction: numbers in the image names tell which frames it has
            found = read_trajectory(path)
    else:
        found = read_trajectory(path)
    finite = np.isfinite(found.T_world_cam).all(axis=(1, 2))
    return Poses(found.times()[finite], found.T_world_cam[finite])
