"""Rows of the peers: Open3D, OctoMap and plain back-projection on a capture, at its poses, ours or dense SLAM's."""

from __future__ import annotations

from pathlib import Path

from .ablations import OURS
from .figures import Figures
from .job import Job
from .map_rows import save_poses, scores_row
from .processes import PartFailed, run_inside

PEERS = {
    "dense_slam_tsdf": "Open3D dense SLAM (1 cm), its poses, TSDF",
    "dense_slam_back_projection": "Open3D dense SLAM (1 cm), its poses, points counted",
    "ours_tsdf": "our poses, TSDF",
    "ours_octomap": "our poses, OctoMap",
    "true_poses_back_projection": "the capture's own poses, points counted (the ceiling)",
    "true_poses_tsdf": "the capture's own poses, TSDF (the ceiling)",
}
"""``POSES_OCCUPANCY``: the source of the poses, and the method that makes voxels."""


def run_dense_slam(job: Job) -> Figures:
    """Run Open3D's dense SLAM on the frames, and save its poses. Returns its seconds a step. Raises PartFailed."""
    figures = run_inside(
        "peer_rows:track_dense_slam", capture=str(job.capture), frames=job.frames, out=str(job.poses("dense_slam"))
    )
    steps = figures["seconds"]
    return {**figures, "seconds_without_decoding": sum(steps.values()) - steps["decode"]}


def track_dense_slam(capture: str, frames: int | None, out: str) -> Figures:
    """Track every frame and leave the aligned poses in ``out``."""
    import numpy as np

    from freeocc3d.capture import open_capture
    from freeocc3d.evaluation.trajectory_errors import measure_trajectory_errors
    from freeocc3d.tracking.trajectory_alignment import Poses, align_trajectories, read_true_poses

    from . import peers

    opened = open_capture(capture)
    used = range(len(opened))[:frames]
    T_world_cam, seconds, failures = peers.dense_slam(opened, used)
    has_pose = np.isfinite(T_world_cam).all(axis=(1, 2))
    estimated, true = Poses(opened.timestamps[has_pose], T_world_cam[has_pose]), read_true_poses(opened)
    alignment = align_trajectories(estimated, true)
    errors = measure_trajectory_errors(estimated, true, alignment)
    first = T_world_cam[np.flatnonzero(has_pose)[0]]
    save_poses(Path(out), alignment.poses(T_world_cam), errors, alignment.rotation @ -first[:3, 1])
    return {
        "frames": len(used),
        "seconds": seconds,
        "tracking_failures": failures,
        "ate_rmse_m": errors.ate_rmse_m,
        "trajectory": errors.as_dict(),
    }


def measure_peer(job: Job, name: str, slam: Figures | None) -> Figures:
    """Measure one peer's occupancy. slam: of dense SLAM, whose poses ``dense_slam_*`` use. Raises PartFailed."""
    source = next(s for s in ("dense_slam", "ours", "true_poses") if name.startswith(s))
    poses = {"dense_slam": job.poses("dense_slam"), "ours": job.poses(OURS), "true_poses": None}[source]
    if source == "dense_slam" and slam is not None and "error" in slam:
        raise PartFailed(slam["error"])
    if poses is not None and not poses.is_file():
        raise PartFailed(f"there are no poses of {source}: also name the variant that makes them")
    truth = job.capture / "ground_truth.npz"
    if not truth.is_file():
        raise PartFailed(f"{job.name} has no ground_truth.npz to score against")
    figures = run_inside(
        "peer_rows:score_occupancy",
        kind=name.removeprefix(f"{source}_"),
        capture=str(job.capture),
        frames=job.frames,
        poses=None if poses is None else str(poses),
        truth=str(truth),
    )
    frames = figures["frames"]
    steps = figures.pop("seconds")
    if source == "dense_slam" and slam is not None:
        steps = {**slam["seconds"], "voxels": sum(steps.values())}
        figures |= {"ate_rmse_m": slam["ate_rmse_m"], "trajectory": slam["trajectory"]}
        figures["peak_memory_bytes"] = max(figures["peak_memory_bytes"], slam["peak_memory_bytes"])
    return {
        **figures,
        "wall_seconds": sum(steps.values()),
        "ms_per_frame": {step: 1e3 * value / frames for step, value in steps.items()},
        "frames_per_second": frames / sum(steps.values()),
    }


def score_occupancy(kind: str, capture: str, frames: int | None, poses: str | None, truth: str) -> Figures:
    """Score a peer's occupied voxels, at the capture's poses (``poses`` None) or those in a file, which are in the true
    frame."""
    import numpy as np

    from freeocc3d.capture import open_capture
    from freeocc3d.evaluation.confusion import Prediction, Scores, count_confusion
    from freeocc3d.evaluation.ground_truth import load_ground_truth
    from freeocc3d.tracking.trajectory_alignment import read_true_poses

    from . import peers

    opened, expected = open_capture(capture), load_ground_truth(truth)
    if poses is None:
        stated = read_true_poses(opened)
        T_true_cam = np.full((len(opened), 4, 4), np.nan)
        T_true_cam[np.searchsorted(opened.timestamps, stated.timestamps)] = stated.T_world_cam
    else:
        T_true_cam = np.load(poses)["poses"]
    used = range(len(opened))[:frames]
    T_true_cam[len(used) :] = np.nan
    lattice = peers.Lattice(expected.origin, expected.shape, expected.voxel_size)
    figures: Figures = {}
    if kind == "tsdf":
        area, seconds = peers.surface_area(opened, T_true_cam, lattice, every=2)
        occupied, figures["surface_m2"] = area >= peers.TSDF_MIN_AREA_M2, float(area.sum())
    else:
        run = {"back_projection": peers.back_projected_occupied, "octomap": peers.octomap_occupied}[kind]
        occupied, seconds = run(opened, T_true_cam, lattice)
    names = expected.classes[1:]
    matrix = count_confusion(expected.labels, Prediction(occupied), expected.masks()["label"], len(names))
    return {**figures, **scores_row(Scores(matrix, names), None, ()), "seconds": seconds, "frames": len(used)}
