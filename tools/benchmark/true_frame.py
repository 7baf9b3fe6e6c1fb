"""Maps in the frame of their given poses, which is that of the truth: maps themselves stand upright."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np


def put_gaussians_in_world(scan_map: Any) -> Any:
    """The Gaussians of a map in the world of its ``T_world_map``."""
    from freeocc3d.gaussians.anchors import align_gaussians

    T = np.array(scan_map.manifest.T_world_map)
    return align_gaussians(scan_map.gaussians, 1.0, T[:3, :3], T[:3, 3])


def put_keyframes_in_world(scan_map: Any) -> Iterator[Any]:
    """Yields the keyframes of a map with their poses in the world of its ``T_world_map``."""
    from freeocc3d.core.types import PosedFrame

    poses = np.array(scan_map.manifest.T_world_map) @ scan_map.trajectory.T_world_keyframe
    for row, (frame, T) in enumerate(zip(scan_map.keyframes, poses, strict=True)):
        yield PosedFrame(frame, T, row)
