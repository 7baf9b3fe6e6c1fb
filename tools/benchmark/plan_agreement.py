"""How well a map's plan for robots agrees with the plan of the truth.

The plan is the output of ``export --format nav2``. The same rule makes the truth's plan from the voxels of the
capture's ground truth, at the centers of the plan's cells. Three figures differ in the cells that they count: those
that both plans know, all that the truth knows, and those of these that the capture's depth images reach. The last two
differ where the truth comes from depth that the capture does not hold: without noise, and beyond the sensor's range.

The cells of the plan and of the truth do not lie on each other, so a wall one cell thick in both may lie in two cells
that only overlap. So obstacles without one of the other plan in the same cell or beside it are counted once more.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from .figures import Figures, Line

PLAN_PICTURE = "plan.png"
"""Our plan, the truth's, and the truth's of what was measured; in the folder that holds the map."""

FREE, UNKNOWN, OCCUPIED = 254, 205, 0
_EVERY = 4  # every n-th frame is tested


def measure_plan(map_path: str) -> Figures:
    """Agreement of a map's plan with the plan of its capture's ground truth."""
    import cv2
    import yaml

    from freeocc3d.core.transforms import invert, transform
    from freeocc3d.evaluation.ground_truth import load_ground_truth
    from freeocc3d.export import export_map
    from freeocc3d.export.nav2 import Options
    from freeocc3d.query.scan_map import load_map
    from freeocc3d.tracking.trajectory_alignment import align_trajectories, read_true_poses, select_estimated_poses

    made = load_map(map_path)
    capture = made.capture
    truth = load_ground_truth(Path(made.manifest.capture.path) / "ground_truth.npz")
    with tempfile.TemporaryDirectory() as folder:
        export_map(made, "nav2", Path(folder) / "plan.yaml")
        told = yaml.safe_load((Path(folder) / "plan.yaml").read_text())
        plan = cv2.imread(str(Path(folder) / "plan.pgm"), cv2.IMREAD_UNCHANGED)[::-1].T
    alignment = align_trajectories(select_estimated_poses(made.trajectory), read_true_poses(capture))
    T_true_map = np.eye(4)
    T_true_map[:3, :3], T_true_map[:3, 3] = alignment.rotation, alignment.translation
    options = Options()
    heights = np.arange(options.min_height + truth.voxel_size / 2, options.max_height, truth.voxel_size)
    i, j, z = np.meshgrid(*(np.arange(n) for n in plan.shape), heights, indexing="ij")
    xy = np.array(told["origin"][:2]) + (np.stack((i, j), axis=-1) + 0.5) * told["resolution"]
    points = np.concatenate((xy, z[..., None]), axis=-1).reshape(-1, 3)
    voxel = np.floor((transform(T_true_map @ invert(made.T_gravity_map), points) - truth.origin) / truth.voxel_size)
    inside = ((voxel >= 0) & (voxel < truth.labels.shape)).all(axis=1)
    voxel = voxel.astype(np.int64)

    def plan_of(labels: Any) -> Any:
        column = np.full(len(voxel), 255, np.uint8)
        column[inside] = labels[tuple(voxel[inside].T)]
        column = column.reshape(*plan.shape, len(heights))
        occupied = ((column > 0) & (column < 255)).any(axis=-1)
        free = (column == 0).mean(axis=-1) >= options.min_free
        return np.where(occupied, OCCUPIED, np.where(free, FREE, UNKNOWN)).astype(np.uint8)

    true = plan_of(truth.labels)
    measured = plan_of(np.where(_measured(capture, truth), truth.labels, 255))
    bar = np.full((8, plan.shape[1]), 128, np.uint8)
    side = np.concatenate((plan, bar, true, bar, measured)).T[::-1]
    picture = str(Path(map_path).parent / PLAN_PICTURE)
    cv2.imwrite(picture, cv2.resize(side, None, fx=3, fy=3, interpolation=cv2.INTER_NEAREST))
    return agreement(plan, true, measured)


def agreement(plan: Any, true: Any, measured: Any) -> Figures:
    """Figures of three plans (X, Y) of FREE, UNKNOWN and OCCUPIED: ours, the truth's, and the truth's of what was
    measured."""
    from scipy import ndimage

    same, known = plan == true, true != UNKNOWN
    both = known & (plan != UNKNOWN)
    told = known & (measured != UNKNOWN)
    free = (plan == FREE) & (true == FREE)
    around = np.ones((3, 3), bool)
    invented = (true == FREE) & (plan == OCCUPIED) & ~ndimage.binary_dilation(true == OCCUPIED, around)
    lost = (true == OCCUPIED) & (plan == FREE) & ~ndimage.binary_dilation(plan == OCCUPIED, around)
    regions = ndimage.label(plan == FREE)[0]
    largest = regions == np.bincount(regions.ravel())[1:].argmax() + 1
    return {
        "cells_known_to_truth": int(known.sum()),
        "known_to_both": float(both.sum() / known.sum()),
        "measured": float(told.sum() / known.sum()),
        "agree_of_both": float(same[both].mean()),
        "agree_of_measured": float(same[told].mean()),
        "agree_of_truth": float(same[known].mean()),
        "free_called_occupied": float((plan[known & (true == FREE)] == OCCUPIED).mean()),
        "occupied_called_free": float((plan[known & (true == OCCUPIED)] == FREE).mean()),
        "obstacles_invented": float(invented[true == FREE].mean()),
        "obstacles_lost": float(lost[true == OCCUPIED].mean()),
        "free_in_one_piece": float(largest[free].mean()),
    }


def _measured(capture: Any, truth: Any) -> Any:
    """(X, Y, Z) bool: the truth's voxels that some frame's depth image reaches, at the true poses."""
    from freeocc3d.core.transforms import invert, transform
    from freeocc3d.tracking.trajectory_alignment import read_true_poses

    poses = read_true_poses(capture)
    frames = dict(zip(poses.timestamps.tolist(), poses.T_world_cam, strict=True))
    at = np.argwhere(truth.labels != 255)
    centers = truth.origin + (at + 0.5) * truth.voxel_size
    reached = np.zeros(len(at), bool)
    for number in range(0, len(capture), _EVERY):
        frame = capture[number]
        if frame.timestamp not in frames:
            continue
        left = np.flatnonzero(~reached)
        x, y, z = transform(invert(frames[frame.timestamp]), centers[left]).T
        camera, depth = frame.intrinsics, frame.depth_m
        ahead = z > 0.05
        u, v = (
            np.floor(f * part / np.where(ahead, z, 1) + c + 0.5)
            for f, part, c in ((camera.fx, x, camera.cx), (camera.fy, y, camera.cy))
        )
        ahead &= (u >= 0) & (v >= 0) & (u < depth.shape[1]) & (v < depth.shape[0])
        found = depth[v[ahead].astype(np.int64), u[ahead].astype(np.int64)]
        reached[left[ahead]] = (found > 0) & (z[ahead] < found + truth.voxel_size)
    out = np.zeros(truth.labels.shape, bool)
    out[tuple(at[reached].T)] = True
    return out


def plan_lines(figures: Figures) -> list[Line]:
    """Rows of a table: what, measured, asked."""
    percent = {name: f"{100 * value:.1f} %" for name, value in figures.items() if isinstance(value, float)}
    return [
        ("plan: cells known to map and truth that agree", percent["agree_of_both"], "90 %"),
        (
            f"  of those that depth images reach ({percent['measured']} of the truth's)",
            percent["agree_of_measured"],
            "90 %",
        ),
        ("  of all cells that the truth knows", percent["agree_of_truth"], "90 %"),
        ("  the truth's free cells that are called occupied", percent["free_called_occupied"], "0 %"),
        ("  the truth's occupied cells that are called free", percent["occupied_called_free"], "0 %"),
        ("  of the truth's free cells: called occupied, with no obstacle beside", percent["obstacles_invented"], "0 %"),
        ("  of the truth's occupied cells: called free, with none of ours beside", percent["obstacles_lost"], "0 %"),
        ("  free cells that are connected, through doors", percent["free_in_one_piece"], "100 %"),
    ]
