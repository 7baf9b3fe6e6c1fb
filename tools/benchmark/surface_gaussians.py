"""Gaussians as layer 2 makes them, without a scan."""

from __future__ import annotations

import math
from typing import Any


def surface_gaussians(count: int) -> Any:
    """Gaussians as layer 2 makes them at 8 cm, one per 4 cm of surface, on square patches of 2 m in random places and
    directions. They are in the order of the patches, since neighbors in a map are neighbors in memory."""
    import numpy as np

    from freeocc3d.core.transforms import quats_to_rotations
    from freeocc3d.core.types import Gaussians

    rng = np.random.default_rng(0)
    patch = np.arange(count) // 2500
    patches = patch[-1] + 1
    quats = rng.normal(size=(patches, 4))
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    edge = 2.0 * math.sqrt(patches)  # of a building 2 m high with 2 m^2 of patches per m^2 of floor
    corners = rng.uniform((0, 0, 0), (edge, edge, 2.0), (patches, 3))
    on_patch = np.concatenate((rng.uniform(0, 2.0, (count, 2)), rng.normal(0, 0.005, (count, 1))), axis=1)
    means = corners[patch] + np.einsum("nij,nj->ni", quats_to_rotations(quats)[patch], on_patch)
    scales = 0.025 * rng.uniform((0.8, 0.8, 0.3), (1.2, 1.2, 1.0), (count, 3))
    return Gaussians(
        means=means.astype(np.float32),
        scales=scales.astype(np.float32),
        quats_wxyz=quats[patch].astype(np.float32),
        opacities=np.full(count, 0.9, np.float32),
        colors=np.zeros((count, 3), np.uint8),
        anchor_keyframe=np.zeros(count, np.int32),
        anchor_cam=means.astype(np.float32),
    )
