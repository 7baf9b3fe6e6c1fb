"""Draws the pictures of a map again, after its frame or its lengths have changed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..core.sampling import spread_evenly
from ..core.types import Gaussians, Submap, Trajectory
from ..gaussians import rendered_views
from ..query.scan_map import Map
from ..settings import registry
from ..storage import map_files
from ..viewer import render_pictures, trajectory_picture


def draw_pictures(
    scan_map: Map,
    folder: Path,
    trajectory: Trajectory,
    gaussians: Gaussians,
    up: NDArray[np.float64],
    factor: float = 1.0,
) -> None:
    """Draws the pictures of the changed ``scan_map`` into a folder.

    trajectory, gaussians, up: the changed ones; up is (3,).  factor: of depth. The map holds only the mapped submap.
    """
    capture = Path(scan_map.manifest.capture.path)
    frames = np.flatnonzero(trajectory.has_pose).astype(np.int32)
    closures = [closure for submap in scan_map.report.get("submaps", [])[:1] for closure in submap["closures"]]
    ends = np.array([closure[:2] for closure in closures], np.int32).reshape(-1, 2)
    held = np.array([closure[2] for closure in closures], bool)
    submap = Submap(frames, trajectory.T_world_cam[frames], trajectory.keyframes, ends, held)
    trajectory_picture.write_path_picture(folder / map_files.PATH_PICTURE, [submap], trajectory, gaussians, up, capture)
    rasterizer = registry.load("gaussians.rasterizers", "cpu").load()
    width = scan_map.settings.fitting.width
    keyframes = scan_map.keyframes
    shown = []
    for row in spread_evenly(len(keyframes), render_pictures.SHOWN):
        frame = keyframes[row]
        frame = frame.scaled(factor)
        view = rendered_views.prepare_captured_view(frame, trajectory.T_world_keyframe[row], width, rasterizer.device)
        shown.append((int(trajectory.keyframes[row]), view))
    render_pictures.write_render_picture(folder / map_files.RENDER_PICTURE, gaussians, shown, rasterizer, capture)
