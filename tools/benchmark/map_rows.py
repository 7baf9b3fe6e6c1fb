"""Rows of the ablations: the command maps a capture, and its poses and ground truth score the map."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from .ablations import Ablation
from .figures import Figures
from .held_out_frames import measure_held_out
from .job import Job
from .poses_from_color import choose_stride
from .processes import COMMAND, PartFailed, run_inside, run_timed


def measure_map(job: Job, variant: Ablation) -> Figures:
    """Map the capture as the variant says, and score it. Raises PartFailed."""
    if variant.lacking:
        raise PartFailed(variant.lacking)
    folder = job.map(variant.name)
    command = [*COMMAND, "reconstruct", str(job.capture), "-o", str(folder), "--config", str(variant.path)]
    if job.frames is not None:
        command += ["--set", f"capture.stop={job.frames}"]
    if variant.color_alone:
        command += ["--set", f"capture.stride={choose_stride(_count_frames(job.capture))}"]
    seconds, peak_bytes, _ = run_timed(command)
    facts = json.loads(run_timed([*COMMAND, "info", str(folder), "--json"])[2])
    used = facts["frames"] - facts["frame_status"].get("unused", 0)
    own = sum(facts["seconds"].values())
    return {
        **run_inside("map_rows:score_map", map=str(folder), capture=str(job.capture), out=str(job.poses(variant.name))),
        "frames": used,
        "frames_with_pose": facts["frames_with_pose"],
        "wall_seconds": seconds,
        "ms_per_frame": {stage: 1e3 * value / used for stage, value in facts["seconds"].items()},
        "frames_per_second": used / own,
        "peak_memory_bytes": peak_bytes,
        "map_bytes": sum(facts["bytes"].values()),
        "gaussians": facts["gaussians"],
        "voxels": facts["voxels"],
    }


def _count_frames(capture: Path) -> int:
    from freeocc3d.capture import open_capture

    return len(open_capture(capture))


def score_map(map: str, capture: str, out: str) -> Figures:
    """ATE and RPE against the capture's poses; IoU and mIoU if it has a ground truth. Leaves the aligned poses of all
    frames in ``out``."""
    from freeocc3d.evaluation import scene_scoring, scoring
    from freeocc3d.evaluation.ground_truth import load_ground_truth
    from freeocc3d.evaluation.trajectory_errors import measure_trajectory_errors
    from freeocc3d.query.scan_map import load_map
    from freeocc3d.tracking.trajectory_alignment import align_trajectories, read_true_poses, select_estimated_poses

    loaded = load_map(map)
    estimated, true = select_estimated_poses(loaded.trajectory), read_true_poses(loaded.capture)
    how = "se3" if loaded.metric else "sim3"
    alignment = align_trajectories(estimated, true, how)
    errors = measure_trajectory_errors(estimated, true, alignment)
    save_poses(Path(out), alignment.poses(loaded.trajectory.T_world_cam), errors, loaded.up @ alignment.rotation.T)
    figures: Figures = {"ate_rmse_m": errors.ate_rmse_m, "trajectory": errors.as_dict()}
    figures["held_out"] = measure_held_out(loaded)
    truth_path = Path(capture) / "ground_truth.npz"
    if truth_path.is_file():
        truth = load_ground_truth(truth_path)
        classes = scoring.collect_common_classes([truth])
        scene = scene_scoring.score_map(loaded, truth, classes, true, how)
        scored = scoring.Evaluation((scene,), classes.classes, how)
        figures |= scores_row(scored.scores, scored.miou(), scored.classes_in_miou)
    return figures


def scores_row(scores: Any, miou: float | None, classes: Any) -> Figures:
    return {
        "iou": scores.iou,
        "precision": scores.precision,
        "recall": scores.recall,
        "miou": miou,
        "classes_in_miou": list(classes) if miou is not None else [],
    }


def save_poses(path: Path, T_true_cam: Any, errors: Any, up: Any) -> None:
    import numpy as np

    np.savez(path, poses=T_true_cam, true=errors.true, aligned=errors.aligned, errors=errors.errors_m, up=up)
