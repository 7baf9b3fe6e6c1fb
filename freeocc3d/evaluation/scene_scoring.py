"""Scores one scene: a prediction of its voxels against the truth and, if there is one, its trajectory.

The prediction comes from a saved map, the Gaussians of another system, per-frame Gaussians or a voxel grid.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..core.errors import FreeOccError
from ..core.types import UNKNOWN
from ..gaussians.splat_ply import read_standard_ply
from ..query.scan_map import Map
from ..settings import config
from ..storage.map_files import CONFIG
from ..tracking.trajectory_alignment import (
    Poses,
    TrajectoryAlignment,
    align_trajectories,
    read_true_poses,
    select_estimated_poses,
)
from ..tracking.upright.up_direction import estimate_up
from . import predictions
from .confusion import Prediction
from .scored_classes import ClassMap
from .trajectory_errors import TrajectoryErrors, describe_few_matches, measure_trajectory_errors
from .true_occupancy import GroundTruth

_PAPERS = "occupancy.projection=probabilistic"
"""Gaussians of other systems become voxels by the paper's equations: they are no discs on a surface."""


@dataclass(frozen=True)
class ScoredScene:
    """One scored scene.

    name: of the scored map, file or folder.  truth: with the scored classes.
    alignment: of the estimated world with the true world.  errors: of the trajectory, None without a trajectory.
    frames: number of frames of the capture, or with a true pose.  frames_with_pose: those with an estimated pose.
    up: (3,) unit vector toward the ceiling in the true world, for pictures.
    notes: sentences that a reader of the figures should know.
    """

    name: str
    truth: GroundTruth
    predicted: Prediction
    alignment: TrajectoryAlignment
    errors: TrajectoryErrors | None
    frames: int | None
    frames_with_pose: int | None
    up: NDArray[np.float64]
    notes: tuple[str, ...]


def score_map(
    scan_map: Map,
    truth: GroundTruth,
    classes: ClassMap,
    poses: Poses | None = None,
    how: str = "se3",
    overrides: Sequence[str] = (),
) -> ScoredScene:
    """Scores a map. poses: the true ones, by default those of the map's capture.

    overrides: options of layer 4 that replace the map's own, such as ``occupancy.threshold=0.4``.
    Raises FreeOccError: no true poses, too few poses for an alignment.
    """
    settings = config.load_saved(scan_map.path / CONFIG, list(overrides))
    estimated = select_estimated_poses(scan_map.trajectory)
    if poses is None:
        try:
            poses = _own_poses(scan_map)
        except FreeOccError:
            if how != "none":
                raise
    alignment = _in_world(scan_map) if poses is None or how == "none" else align_trajectories(estimated, poses, how)
    predicted, note = predictions.predict_from_map(scan_map, settings, alignment, truth, classes)
    notes = [*([note] if note else []), *([] if poses is None else describe_few_matches(estimated, poses))]
    if not scan_map.metric and how != "sim3":
        notes.append("The map's scale is unknown: use --align sim3 to compare it at the true scale.")
    return ScoredScene(
        name=str(scan_map.path),
        truth=truth,
        predicted=predicted,
        alignment=alignment,
        errors=None if poses is None else measure_trajectory_errors(estimated, poses, alignment),
        frames=len(scan_map.trajectory),
        frames_with_pose=len(estimated),
        up=alignment.rotation @ scan_map.up,
        notes=tuple(notes),
    )


def score_gaussians(
    ply: Path,
    truth: GroundTruth,
    classes: ClassMap,
    trajectory: Poses | None,
    poses: Poses | None,
    how: str = "se3",
    overrides: Sequence[str] = (),
) -> ScoredScene:
    """Scores the Gaussians of another system: a 3DGS PLY with its trajectory.

    trajectory: the system's own; the Gaussians are in its world. None if they are in the true frame (``how`` none).
    poses: the true ones. Raises FreeOccError as ``score_map`` does, and for an unreadable PLY.
    """
    alignment, errors = _aligned(trajectory, poses, how, ply)
    gaussians, labels = read_standard_ply(ply)
    semantics = predictions.encode_one_hot(labels, classes, ply)
    predicted = predictions.predict_from_gaussians(
        gaussians, semantics, config.load(None, [_PAPERS, *overrides]), alignment, truth
    )
    notes = [] if labels is not None else [f"The Gaussians of {ply.name} have no classes: mIoU is not available."]
    return _other(ply, truth, predicted, alignment, errors, trajectory, poses, notes)


def score_frames(
    folder: Path, truth: GroundTruth, classes: ClassMap, poses: Poses, overrides: Sequence[str] = ()
) -> ScoredScene:
    """Scores per-frame Gaussians fused by true poses (``predictions.predict_from_frames``)."""
    predicted, fused = predictions.predict_from_frames(
        folder, poses, config.load(None, [_PAPERS, *overrides]), truth, classes
    )
    notes = [f"The Gaussians of {fused} frames were fused by true poses."]
    scene = _other(folder, truth, predicted, TrajectoryAlignment.identity(), None, None, poses, notes)
    return scene


def score_grid(
    path: Path,
    truth: GroundTruth,
    classes: ClassMap,
    trajectory: Poses | None = None,
    poses: Poses | None = None,
    how: str = "se3",
) -> ScoredScene:
    """Scores a finished voxel grid. A grid without a trajectory is already in the true frame.

    trajectory: the one that the grid was made with; for the grid of a map, the map's."""
    alignment, errors = _aligned(trajectory, poses, how if trajectory is not None else "none", path)
    predicted, note = predictions.predict_from_grid(path, alignment, truth, classes, trajectory is not None)
    return _other(path, truth, predicted, alignment, errors, trajectory, poses, [note] if note else [])


def _aligned(
    trajectory: Poses | None, poses: Poses | None, how: str, path: Path
) -> tuple[TrajectoryAlignment, TrajectoryErrors | None]:
    if trajectory is None or poses is None:
        if how != "none":
            lacking = (
                "the trajectory that it was made with (--trajectory)" if trajectory is None else "true poses (--poses)"
            )
            raise FreeOccError(
                f"The alignment of {path} compares camera centers: give {lacking}. If {path.name} is already in the "
                "frame of the true poses, use --align none."
            )
        return TrajectoryAlignment.identity(), None
    alignment = align_trajectories(trajectory, poses, how)
    return alignment, measure_trajectory_errors(trajectory, poses, alignment)


def _other(
    path: Path,
    truth: GroundTruth,
    predicted: Prediction,
    alignment: TrajectoryAlignment,
    errors: TrajectoryErrors | None,
    trajectory: Poses | None,
    poses: Poses | None,
    notes: Sequence[str],
) -> ScoredScene:
    """Returns the scored scene of another system."""
    return ScoredScene(
        name=str(path),
        truth=truth,
        predicted=predicted,
        alignment=alignment,
        errors=errors,
        frames=None if poses is None else len(poses),
        frames_with_pose=None if trajectory is None else len(trajectory),
        up=_up(truth, poses),
        notes=(*notes, *(describe_few_matches(trajectory, poses) if trajectory and poses else ())),
    )


def _up(truth: GroundTruth, poses: Poses | None) -> NDArray[np.float64]:
    """Returns the (3,) up direction in the true world; without poses it is z, as in the published data sets."""
    if poses is None:
        return np.array((0.0, 0.0, 1.0))
    return estimate_up(poses.T_world_cam, truth.centers()[(truth.labels > 0) & (truth.labels != UNKNOWN)])


def _in_world(scan_map: Map) -> TrajectoryAlignment:
    """Returns the map's own ``T_world_map``: to the world of given poses, and of the first keyframe without any."""
    T_world_map = np.array(scan_map.manifest.T_world_map, np.float64)
    return TrajectoryAlignment(1.0, T_world_map[:3, :3], T_world_map[:3, 3])


def _own_poses(scan_map: Map) -> Poses:
    """Returns the true poses in the map's capture. Raises FreeOccError."""
    try:
        capture = scan_map.capture
    except FreeOccError as error:
        raise FreeOccError(f"{error} Name the true poses with --poses.") from error
    return read_true_poses(capture)
