"""A map's occupancy on the lattice of a ground truth: projected there, never resampled from a finished grid."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .. import config, registry
from ..gaussians import anchors
from ..keyframes import Keyframes
from ..occupancy import build, carve, splat
from ..store import CONFIG, Map
from ..types import Frame
from .align import Alignment


def occupied_on_lattice(
    scan_map: Map,
    alignment: Alignment,
    origin: NDArray[np.float64],
    shape: tuple[int, int, int],
    voxel_size: float | None = None,
) -> NDArray[np.bool_]:
    """(X, Y, Z) whether the map calls each voxel of a lattice occupied; unknown is not occupied.

    origin: (3,) lower corner of the lattice in the true frame, metres.  voxel_size: of the lattice, metres.
    The Gaussians are moved by the alignment (paper, "Coordinate System Alignment") and projected at the lattice's voxel
    centres; free space is carved there again from the map's keyframes.
    """
    settings = config.load(scan_map.path / CONFIG)
    splatting = registry.build_options(splat, settings["occupancy"])
    if voxel_size is not None:
        splatting = splat.Options(**{**splatting.__dict__, "voxel_size": float(voxel_size)})
    scale, R, t = alignment.scale, alignment.rotation, alignment.translation
    T_world_keyframe = scan_map.trajectory.T_world_keyframe.copy()
    T_world_keyframe[:, :3, 3] = scale * T_world_keyframe[:, :3, 3] @ R.T + t
    T_world_keyframe[:, :3, :3] = R @ T_world_keyframe[:, :3, :3]
    gaussians = anchors.aligned(scan_map.gaussians, scale, R, t)
    keyframes = _Scaled(scan_map.keyframes, scale)
    occupancy = build.build_occupancy(
        gaussians,
        np.zeros((len(gaussians), 0), np.float16),
        keyframes,
        T_world_keyframe,
        splatting,
        registry.build_options(carve, settings["carving"]),
        origin=np.asarray(origin, np.float64),
    )
    occupied = np.zeros(shape, bool)
    voxels = occupancy.occupied_voxels()
    inside = ((voxels >= 0) & (voxels < shape)).all(axis=1)
    occupied[tuple(voxels[inside].T)] = True
    return occupied


class _Scaled(Sequence[Frame]):
    """Keyframes whose depth is in the true frame's metres; a similarity scales the cameras' frames as well."""

    def __init__(self, keyframes: Keyframes, scale: float):
        self.keyframes = keyframes
        self.scale = np.float32(scale)

    def __len__(self) -> int:
        return len(self.keyframes)

    def __getitem__(self, row: Any) -> Any:
        frame = self.keyframes[row]
        return replace(frame, depth_m=frame.depth_m * self.scale)
