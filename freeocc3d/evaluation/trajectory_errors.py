"""Measures the errors of a trajectory after its alignment: absolute (ATE) and relative by traveled distance (RPE).

Sources: J. Sturm et al., IROS 2012, Sec. IV; pairs of frames as in evo's ``--all_pairs --pairs_from_reference -u m``
(M. Grupp, evo, https://github.com/MichaelGrupp/evo), so that figures compare. Each frame pairs with the frame whose
traveled distance along the true path is nearest to the given distance, within a tenth of it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..capture import associate
from ..capture.poses.trajectory_files import SAME_TIME_S
from ..core.errors import FreeOccError
from ..core.transforms import invert
from ..tracking.trajectory_alignment import Poses, TrajectoryAlignment

DISTANCES_M = (0.1, 0.5, 1.0, 2.0)
"""Traveled distances for the relative errors, meters."""

_TOLERANCE = 0.1

_FEWEST_MATCHES, _LEAST_SHARE = 10, 0.2
"""Frames with a true pose, and their share of all estimated ones, below which an alignment is doubtful."""


@dataclass(frozen=True)
class RelativeError:
    """Root mean square over pairs of frames with ``distance_m`` of path between them: meters and degrees."""

    distance_m: float
    pairs: int
    translation_rmse_m: float
    rotation_rmse_deg: float


@dataclass(frozen=True)
class TrajectoryErrors:
    """The errors after the alignment, over the M frames with a pose in both trajectories.

    timestamps: (M,) of the estimate.  true, aligned: (M, 3) camera centers in the true world, meters.
    relative: one for each distance that some pair of frames has.
    """

    timestamps: NDArray[np.float64]
    true: NDArray[np.float64]
    aligned: NDArray[np.float64]
    relative: tuple[RelativeError, ...]

    @property
    def errors_m(self) -> NDArray[np.float64]:
        """(M,) distances of the aligned camera centers from the true ones, meters."""
        return np.asarray(np.linalg.norm(self.aligned - self.true, axis=1))

    @property
    def ate_rmse_m(self) -> float:
        """Absolute trajectory error, root mean square, meters."""
        return float(np.sqrt((self.errors_m**2).mean()))

    def as_dict(self) -> dict[str, Any]:
        """Returns plain values; lengths in meters, angles in degrees."""
        errors = self.errors_m
        return {
            "frames_matched": len(errors),
            "ate_m": {
                "rmse": self.ate_rmse_m,
                "mean": float(errors.mean()),
                "median": float(np.median(errors)),
                "max": float(errors.max()),
            },
            "rpe": [vars(error) for error in self.relative],
        }


def measure_trajectory_errors(
    estimated: Poses, true: Poses, alignment: TrajectoryAlignment, distances_m: tuple[float, ...] = DISTANCES_M
) -> TrajectoryErrors:
    """Measures all errors. Raises FreeOccError if no frame has a pose in both trajectories."""
    rows_est, rows_true = associate(estimated.timestamps, true.timestamps)
    if not len(rows_est):
        raise FreeOccError(
            "No frame has both an estimated and a true pose: check that the timestamps belong to the same recording. "
            f"Estimated: {_span(estimated)}; true: {_span(true)}."
        )
    T_est = alignment.poses(estimated.T_world_cam[rows_est])
    T_true = true.T_world_cam[rows_true]
    relative = tuple(error for d in distances_m if (error := measure_relative_error(T_est, T_true, d)) is not None)
    return TrajectoryErrors(estimated.timestamps[rows_est], T_true[:, :3, 3], T_est[:, :3, 3], relative)


def describe_few_matches(estimated: Poses, true: Poses) -> list[str]:
    """A note if so few frames have a pose in both that the alignment is doubtful."""
    matched, count = len(associate(estimated.timestamps, true.timestamps)[0]), len(estimated)
    if matched >= max(min(_FEWEST_MATCHES, count), _LEAST_SHARE * count):
        return []
    return [
        f"Only {matched} of {count} estimated poses have a true pose within {SAME_TIME_S:g} s, so the scores are "
        f"doubtful. Check that the timestamps belong to the same recording. Estimated: {_span(estimated)}; true: "
        f"{_span(true)}."
    ]


def measure_relative_error(
    T_est: NDArray[np.float64], T_true: NDArray[np.float64], distance_m: float
) -> RelativeError | None:
    """Measures (M, 4, 4) matched poses; returns None if no two frames are that far apart."""
    first, second = pair_by_path(T_true[:, :3, 3], distance_m)
    if not len(first):
        return None
    moved_true = invert(T_true[first]) @ T_true[second]
    moved_est = invert(T_est[first]) @ T_est[second]
    error = invert(moved_true) @ moved_est
    # The angle comes from its sine and cosine: near zero, the cosine alone loses half of the digits.
    R = error[:, :3, :3]
    sine = 0.5 * np.linalg.norm(
        np.stack((R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]), axis=1), axis=1
    )
    angle = np.arctan2(sine, 0.5 * (np.trace(R, axis1=1, axis2=2) - 1))
    translation = np.linalg.norm(error[:, :3, 3], axis=1)
    return RelativeError(
        distance_m,
        len(first),
        float(np.sqrt((translation**2).mean())),
        float(np.rad2deg(np.sqrt((angle**2).mean()))),
    )


def pair_by_path(centers: NDArray[np.float64], distance_m: float) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Returns the rows (P,), (P,) of the (M, 3) centers with a path of ``distance_m`` between them, within a tenth."""
    path = np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(centers, axis=0), axis=1))))
    first = np.arange(len(path) - 1)
    beyond = np.maximum(np.searchsorted(path, path[first] + distance_m), first + 1)
    # Takes the nearer of the last point before the distance and the first beyond it; for a resting camera, its first
    # frame.
    before = np.maximum(np.searchsorted(path, path[np.maximum(beyond - 1, 0)]), first + 1)
    beyond = np.minimum(beyond, len(path) - 1)
    off_before, off_beyond = (np.abs(path[end] - path[first] - distance_m) for end in (before, beyond))
    second = np.where(off_before <= off_beyond, before, beyond)
    near = np.minimum(off_before, off_beyond) <= _TOLERANCE * distance_m
    return first[near], second[near]


def _span(poses: Poses) -> str:
    if not len(poses):
        return "no poses"
    return f"{len(poses)} from {poses.timestamps[0]:g} to {poses.timestamps[-1]:g} s"
