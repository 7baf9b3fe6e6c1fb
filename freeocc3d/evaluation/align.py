"""The estimated trajectory against the true one: the best alignment, and what remains (absolute trajectory error).

Source: J. Sturm et al., A Benchmark for the Evaluation of RGB-D SLAM Systems, IROS 2012, Sec. IV-B; the alignment is
Umeyama's (``geometry.umeyama``) on the camera centres of the frames that have a pose in both.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..capture.base import Capture
from ..errors import FreeOccError
from ..geometry import umeyama
from ..types import Trajectory


@dataclass(frozen=True)
class Alignment:
    """The similarity that takes the estimate's world to the true one: x_true = scale * rotation @ x_est + translation.

    scale: 1 unless it was asked for.  rotation: (3, 3).  translation: (3,) metres.
    ate_rmse_m: root mean square distance of the aligned camera centres from the true ones, metres.
    frames_matched: frames that have a pose in both.
    """

    scale: float
    rotation: NDArray[np.float64]
    translation: NDArray[np.float64]
    ate_rmse_m: float
    frames_matched: int

    def to_true(self, points_est: NDArray[np.floating]) -> NDArray[np.float64]:
        """(..., 3) points of the estimate's world in the true world."""
        return np.asarray(self.scale * points_est @ self.rotation.T + self.translation)

    def to_estimate(self, points_true: NDArray[np.floating]) -> NDArray[np.float64]:
        """(..., 3) points of the true world in the estimate's world: the inverse of ``to_true``."""
        return np.asarray((points_true - self.translation) @ self.rotation / self.scale)

    def to_json(self) -> dict[str, Any]:
        """``alignment`` of ``evaluate --json``."""
        return {
            "scale": self.scale,
            "rotation": self.rotation.tolist(),
            "translation": self.translation.tolist(),
        }


def align_trajectory(
    estimated: Trajectory, T_world_cam_true: NDArray[np.float64], with_scale: bool = False
) -> Alignment:
    """Align an estimate to the truth over the frames that have a pose in both.

    T_world_cam_true: (N, 4, 4), row n = frame n of the capture, NaN where there is none.
    with_scale: Sim(3), for trajectories without a metric scale; otherwise SE(3).
    Raises FreeOccError: lengths differ, fewer than three frames match, camera centres on one line.
    """
    centers_est, centers_true = _matched_centers(estimated, T_world_cam_true)
    scale, R, t = umeyama(centers_est, centers_true, with_scale)
    error = _rmse(scale * centers_est @ R.T + t, centers_true)
    return Alignment(scale, np.asarray(R, np.float64), np.asarray(t, np.float64), error, len(centers_est))


def ate_rmse(estimated: Trajectory, T_world_cam_true: NDArray[np.float64], with_scale: bool = False) -> float:
    """Absolute trajectory error after the best alignment, metres; arguments and errors of ``align_trajectory``."""
    return align_trajectory(estimated, T_world_cam_true, with_scale).ate_rmse_m


def true_poses(capture: Capture) -> NDArray[np.float64]:
    """(N, 4, 4) the poses that a capture states, NaN where it has none. Raises FreeOccError if it has none at all."""
    poses = np.full((len(capture), 4, 4), np.nan)
    for index in range(len(capture)):
        T_world_cam = capture.pose(index)
        if T_world_cam is not None:
            poses[index] = T_world_cam
    if np.isnan(poses).all():
        raise FreeOccError(f"{capture.path} brings no poses to compare with: name a file of true poses.")
    return poses


def _matched_centers(
    estimated: Trajectory, T_world_cam_true: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(M, 3) estimated and true camera centres of the frames that have both."""
    if T_world_cam_true.shape != (len(estimated), 4, 4):
        raise FreeOccError(
            f"The estimate has {len(estimated)} frames but the true poses have the shape {T_world_cam_true.shape}: "
            "are both of the same capture?"
        )
    both = estimated.has_pose & np.isfinite(T_world_cam_true).all(axis=(1, 2))
    return estimated.T_world_cam[both, :3, 3], T_world_cam_true[both, :3, 3]


def _rmse(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    return float(np.sqrt(((a - b) ** 2).sum(axis=1).mean()))
