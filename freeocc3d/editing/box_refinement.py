"""A box of a saved map with finer voxels: it is lifted again, in finer cells, from the keyframes that see it.

The Gaussians of a map are as coarse as its voxels. What lies between two of them (the gap between two cups) is not in
them, but in the keyframes, which the map keeps. The result is a map of the box alone, in the same frame.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import msgspec
import numpy as np
from numpy.typing import NDArray

from ..core.errors import FreeOccError, MapError
from ..core.progress import Progress
from ..core.transforms import back_project, transform
from ..core.types import BLOCK, Frame, Gaussians, PosedFrame, Trajectory
from ..gaussians import anchors
from ..language import lifting
from ..language.feature_codec import Codec
from ..occupancy import build
from ..occupancy.confirmed_depth import hide_unconfirmed
from ..query.regions import Region
from ..query.scan_map import Map, load_map
from ..settings.config import Settings
from ..storage.keyframes import Keyframes
from ..storage.manifest import Refined, vector
from ..storage.work_folder import WorkFolder
from ..storage.writer import MapParts, write_changed_map

SMALLEST_VOXEL_M = 0.001
_MOST_BLOCKS = 1 << 18  # 13 bytes a voxel: 1.7 GB
_LOOK_STRIDE = 2  # every n-th pixel decides whether a keyframe sees the box
AROUND = 3.0
"""Margin around the box, in new voxels, from which Gaussians reach into it."""


@dataclass(frozen=True)
class Box:
    """low, high: (3,) opposite corners in the map's frame, meters."""

    low: NDArray[np.float64]
    high: NDArray[np.float64]

    def __post_init__(self) -> None:
        if not (np.isfinite(self.low).all() and np.isfinite(self.high).all() and (self.low < self.high).all()):
            raise MapError(
                "A box has a lower and an upper corner, x0 y0 z0 x1 y1 z1 in meters, with x0 < x1, y0 < y1 "
                f"and z0 < z1; got {' '.join(f'{value:g}' for value in (*self.low, *self.high))}."
            )

    def contains(self, points: NDArray[np.floating], margin: float) -> NDArray[np.bool_]:
        """(P,) whether each of (P, 3) points is inside, or no farther outside than the margin along any axis."""
        return np.asarray(((points >= self.low - margin) & (points <= self.high + margin)).all(axis=1))


def enclose_region(region: Region, voxel_size: float) -> Box:
    """The bounding box of a query's region, enlarged by two voxels of the map on every side."""
    return Box(region.box_min - 2 * voxel_size, region.box_max + 2 * voxel_size)


def refine_box(
    scan_map: Map,
    box: Box,
    voxel_size: float,
    output: str | Path,
    *,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> Map:
    """Write a map of a box of another map, with voxels of ``voxel_size`` meters, to the folder ``output``.

    The box is widened to whole blocks of 8 voxels, and down so that z = 0 is the middle of a layer if the map stands
    upright. Raises FreeOccError if the box is empty or too large, if no keyframe
    sees a surface in it, or if the folder exists.
    """
    progress = progress or Progress()
    if not SMALLEST_VOXEL_M <= voxel_size <= scan_map.manifest.voxel_size_m:
        raise MapError(
            f"Voxels of {voxel_size:g} m are not possible: choose a size from {SMALLEST_VOXEL_M:g} m to the map's own "
            f"{scan_map.manifest.voxel_size_m:g} m."
        )
    if scan_map.manifest.upright is not None:
        box = _on_floor(box, voxel_size)
    blocks = tuple(math.ceil(edge - 1e-6) for edge in (box.high - box.low) / (BLOCK * voxel_size))
    if math.prod(blocks) > _MOST_BLOCKS:
        edge = BLOCK * voxel_size * _MOST_BLOCKS ** (1 / 3)
        raise MapError(
            f"The box holds {math.prod(blocks) * BLOCK**3:,} voxels of {voxel_size:g} m, which are too many: choose "
            f"edges of at most {edge:.1f} m, or larger voxels."
        )
    with WorkFolder.made_of(scan_map.path, Path(output), overwrite) as work:
        settings = read_settings(scan_map).changed("occupancy", voxel_size=voxel_size)
        seeing, trajectory = _seeing(scan_map, box, AROUND * voxel_size, progress)
        poses = trajectory.T_world_keyframe

        def posed() -> Iterator[PosedFrame]:
            for row, frame in enumerate(seeing):
                yield PosedFrame(frame, poses[row], row)

        gaussians = lift_gaussians(posed, box, voxel_size, settings, poses, box.low, progress)
        if not len(gaussians):
            raise MapError(f"No keyframe of {scan_map.path} shows a surface in the box: choose another box.")
        features = lift_features_again(scan_map, seeing, poses, gaussians, settings, progress)
        progress.stage("occupancy", len(seeing))
        occupancy = build.build_occupancy(
            gaussians,
            features,
            hide_unconfirmed(posed(), scan_map.gaussians, scan_map.manifest.voxel_size_m, settings.gaussians.cell_size),
            settings.occupancy,
            settings.carving,
            origin=box.low,
            blocks=(blocks[0], blocks[1], blocks[2]),
            progress=progress.advance,
        )
        if not len(occupancy.colors):
            raise MapError(
                f"No voxel of {voxel_size:g} m in the box is occupied: {scan_map.path} holds no surface there."
            )
        progress.stage("saving")
        corners = (*vector(box.low), *vector(box.high))
        refined = Refined(map=str(scan_map.path.absolute()), box=corners)
        parts = MapParts(
            msgspec.structs.replace(scan_map.manifest, refined=refined), settings, lambda: scan_map.report, occupancy,
            Codec.fit(features), features, gaussians, trajectory, seeing, draw=lambda folder: None,
        )  # fmt: skip
        write_changed_map(scan_map, work, Path(output), parts)
    return load_map(output)


def _on_floor(box: Box, voxel_size: float) -> Box:
    """The box with its lower face half a voxel above or below a multiple of voxels from z = 0."""
    low = box.low.astype(np.float64)
    low[2] = (math.floor(low[2] / voxel_size + 0.5 + 1e-6) - 0.5) * voxel_size
    return Box(low, box.high)


def read_settings(scan_map: Map) -> Settings:
    """The map's own settings, with layer 4 on the CPU."""
    return scan_map.settings.changed("occupancy", device="cpu")


def _seeing(scan_map: Map, box: Box, margin: float, progress: Progress) -> tuple[Keyframes, Trajectory]:
    """The keyframes that show something in the box, and the trajectory with only these."""
    trajectory, keyframes = scan_map.trajectory, scan_map.keyframes
    progress.stage("keyframes", len(keyframes))
    seen = np.zeros(len(keyframes), bool)
    for row, (frame, T) in enumerate(zip(keyframes, trajectory.T_world_keyframe, strict=True)):
        seen[row] = box.contains(_points(frame, T, _LOOK_STRIDE)[1], margin).any()
        progress.advance(row + 1)
    frames = trajectory.keyframes[seen]
    return keyframes.only(frames), trajectory.only_keyframes(frames)


def _points(
    frame: Frame, T_world_cam: NDArray[np.float64], stride: int = 1
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """(P, 2) pixels u, v with depth, and their (P, 3) points in the world; every ``stride``-th pixel in both
    directions."""
    v, u = stride * np.stack(np.nonzero(frame.depth_m[::stride, ::stride]))
    pixels = np.stack((u, v), axis=1)
    points = back_project(pixels, frame.depth_m[v, u], frame.intrinsics)
    return pixels, transform(T_world_cam, points.astype(np.float64))


class Space(Protocol):
    """A part of space."""

    def contains(self, points: NDArray[np.floating], margin: float) -> NDArray[np.bool_]:
        """(P,) whether each of (P, 3) points is inside, or no farther outside than the margin along any axis."""


def lift_gaussians(
    posed: Callable[[], Iterator[PosedFrame]],
    space: Space,
    voxel_size: float,
    settings: Settings,
    T_world_keyframe: NDArray[np.float64],
    origin: NDArray[np.float64],
    progress: Progress,
) -> Gaussians:
    """Layer 2 of a part of space, in cells of half a voxel, from keyframes with (K, 4, 4) poses.

    posed: yields the keyframes at each call.  origin: (3,) a corner of voxels.
    """
    options = settings.gaussians.changed(cell_size=None, pixel_stride=None)  # both follow the voxels
    margin = AROUND * voxel_size
    progress.stage("gaussians", len(T_world_keyframe))
    cells = anchors.AnchoredCells(options, 0.5 * voxel_size, T_world_keyframe, origin)
    for done, look in enumerate(posed(), 1):
        pixels, points = _points(
            look.frame, look.T_world_cam, anchors.choose_stride(look.frame, options, cells.cell_size)
        )
        outside = pixels[~space.contains(points, margin)]
        depth_m = look.frame.depth_m.copy()
        depth_m[outside[:, 1], outside[:, 0]] = 0
        cells.add(look._replace(frame=dataclasses.replace(look.frame, depth_m=depth_m)))
        progress.advance(done)
    gaussians = cells.gaussians(posed())
    return gaussians[space.contains(gaussians.means, margin)]


def lift_features_again(
    scan_map: Map,
    frames: Sequence[Frame],
    T_world_cam: NDArray[np.float64],
    gaussians: Gaussians,
    settings: Settings,
    progress: Progress,
) -> NDArray[np.float16]:
    """Layer 3 of these Gaussians. If the encoder cannot be loaded, each takes the features of the map's nearest
    Gaussian."""
    try:
        encoder = scan_map.encoder
    except FreeOccError as error:
        name = scan_map.manifest.encoder.name
        progress.warn(f"The encoder '{name}' cannot be loaded, so features stay as coarse as the map's: {error}")
        from scipy.spatial import cKDTree

        nearest = cKDTree(scan_map.gaussians.means).query(gaussians.means)[1]
        return scan_map.gaussian_features[nearest]
    return lifting.lift_features(gaussians, frames, T_world_cam, encoder, settings.language, progress)
