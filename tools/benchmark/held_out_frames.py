"""How well a map's Gaussians show frames that they were not fitted to: every tenth frame of the capture."""

from __future__ import annotations

import dataclasses
from typing import Any

EVERY = 10


def measure_held_out(loaded: Any) -> dict[str, Any]:
    """PSNR and depth error on every tenth frame that has a pose and is not a keyframe, at the map's own poses."""
    from freeocc3d.gaussians import fitting, rendered_views
    from freeocc3d.gaussians.rasterizers import cpu

    capture, trajectory = loaded.capture, loaded.trajectory
    keyframes = set(trajectory.keyframes.tolist())
    rows = [n for n in range(0, len(trajectory), EVERY) if trajectory.has_pose[n] and n not in keyframes]
    rasterizer, width = cpu.load(), fitting.Options().width
    views = [
        rendered_views.prepare_captured_view(capture[n], trajectory.T_world_cam[n], width, rasterizer.device)
        for n in rows
    ]
    return {
        "frames": len(rows),
        **dataclasses.asdict(rendered_views.measure_fidelity(loaded.gaussians, views, rasterizer)),
    }
