"""A manifest of a tiny map, for tests that need one without a map."""

from __future__ import annotations

from typing import Any

import numpy as np
from msgspec import structs

from freeocc3d.storage.manifest import CaptureRecord, EncoderRecord, Manifest, MapCounts, VoxelCounts, matrix


def tiny_manifest(**changes: Any) -> Manifest:
    manifest = Manifest(
        capture=CaptureRecord(path="builtin:room", format="synthetic", frames=240),
        up=(0.0, 0.0, 1.0),
        T_world_map=matrix(np.eye(4)),
        encoder=EncoderRecord(name="color", state={}),
        freeocc3d="0.1.0",
        voxel_size_m=0.1,
        origin=(0.0, 0.0, 0.0),
        counts=MapCounts(
            gaussians=2, voxels=VoxelCounts(occupied=1, free=2), frames=240, frames_with_pose=3, submaps=1
        ),
        keyframes=(0, 2),
        files={},
    )
    return structs.replace(manifest, **changes)
