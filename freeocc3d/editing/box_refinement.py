"""A box of a saved map at finer voxels: lifted again from the keyframes that see it, in finer cells.

The Gaussians of a map are as coarse as its voxels, so that what lies between two of them (a cup beside another) is not
in them, but in the keyframes, which the map keeps. What comes out is a map of the box alone, in the same frame.
"""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ..capture import Capture, open_capture
from ..capture.focal_correction import Reregistered
from ..core.errors import FreeOccError, MapError
from ..core.progress import Progress
from ..core.transforms import back_project, transform
from ..core.tum_files import write_tum
from ..core.types import BLOCK, Frame, Gaussians, Occupancy, PosedFrame, Trajectory
from ..gaussians import anchors
from ..gaussians.point_cloud import write_gaussian_ply
from ..language import lifting
from ..language.feature_codec import Codec
from ..occupancy import build
from ..query.regions import Region
from ..settings import config, registry
from ..settings.config import Settings
from ..storage import store
from ..storage.keyframes import Keyframes
from ..storage.store import Map, load_map
from ..storage.work_folder import WorkFolder

SMALLEST_VOXEL_M = 0.001
_MOST_BLOCKS = 1 << 18  # 13 bytes a voxel: 1.7 GB
_LOOK_STRIDE = 2  # pixels from which it is decided whether a keyframe sees the box
AROUND = 3.0
"""Voxels of the box's new size around it, from where Gaussians reach into it."""


@dataclass(frozen=True)
class Box:
    """low, high: (3,) opposite corners in the map's frame, metres."""

    low: NDArray[np.float64]
    high: NDArray[np.float64]

    def __post_init__(self) -> None:
        if not (np.isfinite(self.low).all() and np.isfinite(self.high).all() and (self.low < self.high).all()):
            raise MapError(
                "A box has a lower and an upper corner, x0 y0 z0 x1 y1 z1 in metres, each of the first three less than "
                f"its counterpart; got {' '.join(f'{value:g}' for value in (*self.low, *self.high))}."
            )

    def contains(self, points: NDArray[np.floating], margin: float) -> NDArray[np.bool_]:
        """(P,) whether each of (P, 3) points is inside, or no farther outside than the margin along any axis."""
        return np.asarray(((points >= self.low - margin) & (points <= self.high + margin)).all(axis=1))


def enclose_region(region: Region, voxel_size: float) -> Box:
    """The box of what a query found, and two of the map's voxels around it."""
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
    """Write a map of a box of another map, with voxels of ``voxel_size`` metres, to the folder ``output``.

    The box is widened to whole blocks of 8 voxels. Raises FreeOccError: the box is empty, or holds more than can be
    kept, no keyframe sees a surface in it, or the folder exists.
    """
    progress = progress or Progress()
    if not SMALLEST_VOXEL_M <= voxel_size <= scan_map.manifest["voxel_size_m"]:
        raise MapError(
            f"Voxels of {voxel_size:g} m cannot be had: give from {SMALLEST_VOXEL_M:g} up to the map's own "
            f"{scan_map.manifest['voxel_size_m']:g}."
        )
    blocks = tuple(math.ceil(edge - 1e-6) for edge in (box.high - box.low) / (BLOCK * voxel_size))
    if math.prod(blocks) > _MOST_BLOCKS:
        edge = BLOCK * voxel_size * _MOST_BLOCKS ** (1 / 3)
        raise MapError(
            f"The box holds {math.prod(blocks) * BLOCK**3:,} voxels of {voxel_size:g} m, more than can be kept: take "
            f"one of up to {edge:.1f} m an edge, or larger voxels."
        )
    work = WorkFolder.made_of(scan_map.path, Path(output), overwrite)
    settings = read_settings(scan_map).changed("occupancy", voxel_size=voxel_size)
    seeing, rows, trajectory = _seeing(scan_map, box, AROUND * voxel_size, progress)
    trajectory = trajectory.only_keyframes(trajectory.keyframes[rows])
    poses = trajectory.T_world_keyframe

    def posed() -> Iterator[PosedFrame]:
        for row, frame in enumerate(seeing):
            yield PosedFrame(frame, poses[row], row)

    gaussians = lift_gaussians(posed, box, voxel_size, settings, poses, progress)
    if not len(gaussians):
        raise MapError(f"No keyframe of {scan_map.path} shows a surface in the box: nothing can be refined there.")
    features = lift_features_again(scan_map, seeing, poses, gaussians, settings, progress)
    progress.stage("occupancy", len(seeing))
    occupancy = build.build_occupancy(
        gaussians,
        features,
        posed(),
        settings.occupancy,
        settings.carving,
        origin=box.low,
        blocks=(blocks[0], blocks[1], blocks[2]),
        progress=progress.advance,
    )
    if not len(occupancy.colors):
        raise MapError(f"No voxel of {voxel_size:g} m in the box is occupied: {scan_map.path} holds no surface there.")
    progress.stage("saving")
    with work.writing(Path(output), [str(scan_map.path), *box.low.tolist(), *box.high.tolist()], settings) as folder:
        keyframes = Keyframes(folder / store.KEYFRAMES)
        for frame in seeing:
            keyframes.append(frame)
        keyframes.save_index()
        write_gaussian_ply(gaussians, folder / store.GAUSSIANS)
        store.write_occupancy(folder, occupancy, Codec.fit(features), features)
        write_tum(folder / store.TRAJECTORY, trajectory)
        (folder / store.REPORT).write_text(json.dumps(scan_map.report), encoding="utf-8")
        store.write_manifest(folder, _manifest(scan_map, box, trajectory.keyframes, gaussians, occupancy))
    return load_map(output)


def read_settings(scan_map: Map) -> Settings:
    """The map's own; on the processor wherever the map was made."""
    return config.load_saved(scan_map.path / store.CONFIG).changed("occupancy", device="cpu")


def _seeing(
    scan_map: Map, box: Box, margin: float, progress: Progress
) -> tuple[Keyframes, NDArray[np.int64], Trajectory]:
    """The keyframes that show something in the box, their rows among all, and the trajectory."""
    trajectory, keyframes = scan_map.trajectory, scan_map.keyframes
    progress.stage("keyframes", len(keyframes))
    seen = np.zeros(len(keyframes), bool)
    for row, (frame, T) in enumerate(zip(keyframes, trajectory.T_world_keyframe, strict=True)):
        seen[row] = box.contains(_points(frame, T, _LOOK_STRIDE)[1], margin).any()
        progress.advance(row + 1)
    rows = np.flatnonzero(seen)
    return keyframes.only(trajectory.keyframes[rows]), rows, trajectory


def _points(
    frame: Frame, T_world_cam: NDArray[np.float64], stride: int = 1
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """(P, 2) measured pixels u, v, and (P, 3) where they are in the world; every n-th pixel in both directions."""
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
    progress: Progress,
) -> Gaussians:
    """Layer 2 of what lies in a part of space, in cells of half a voxel, from keyframes with (K, 4, 4) poses.

    posed: gives the keyframes, each time that it is called.
    """
    options = settings.gaussians.changed(cell_size=None, pixel_stride=None)  # both follow the voxels
    margin = AROUND * voxel_size
    progress.stage("gaussians", len(T_world_keyframe))
    cells = anchors.AnchoredCells(options, 0.5 * voxel_size, T_world_keyframe)
    for done, look in enumerate(posed(), 1):
        pixels, points = _points(look.frame, look.T_world_cam, cells.stride(look.frame))
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
    """Layer 3 of these Gaussians; where the encoder cannot be had again, the features of the map's own nearest."""
    name = scan_map.manifest["encoder"]["name"]
    module = registry.load("language.encoders", name)
    try:
        capture = _capture(scan_map, settings) if getattr(module, "NEEDS_CAPTURE", True) else None
        encoder = settings.load_backend("language", capture)
    except FreeOccError as error:
        progress.warn(f"The encoder '{name}' cannot be used again, so features stay as coarse as the map's: {error}")
        from scipy.spatial import cKDTree

        nearest = cKDTree(scan_map.gaussians.means).query(gaussians.means)[1]
        return scan_map.gaussian_features[nearest]
    return lifting.lift_features(gaussians, frames, T_world_cam, encoder, settings.language, progress)


def _capture(scan_map: Map, settings: Settings) -> Capture:
    """The capture that the map was made of, as it was read then. Raises FreeOccError."""
    path = scan_map.manifest["capture"]["path"]
    capture = open_capture(path, settings.capture, settings.backends.get("capture"))
    color_focal = float(scan_map.report.get("color_focal", 1.0))
    return capture if color_focal == 1 else Reregistered(capture, color_focal)


def _manifest(
    scan_map: Map, box: Box, keyframes: NDArray[np.int32], gaussians: Gaussians, occupancy: Occupancy
) -> dict[str, Any]:
    others = "format_version", "files", "finest_voxel_m"
    kept = {key: value for key, value in scan_map.manifest.items() if key not in others}
    return {
        **kept,
        "voxel_size_m": occupancy.voxel_size,
        "origin": occupancy.origin.tolist(),
        "refined": {"map": str(scan_map.path.absolute()), "box": [*box.low.tolist(), *box.high.tolist()]},
        "counts": {**kept["counts"], "gaussians": len(gaussians), "voxels": store.counts(occupancy)},
        "keyframes": keyframes.tolist(),
    }
