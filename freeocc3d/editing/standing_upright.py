"""Lets a map of an earlier version, which lies as its first camera or its given poses did, stand upright.

Poses and Gaussians move as they are. Voxels are not turned: they are projected and carved again, on a lattice in the
new frame, from the Gaussians and the keyframes.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray

from ..core.errors import FreeOccError, MapError
from ..core.progress import Progress
from ..core.transforms import invert
from ..core.types import Gaussians, Occupancy, PosedFrame, Trajectory
from ..gaussians import anchors
from ..language.feature_codec import Codec
from ..occupancy import build
from ..occupancy.confirmed_depth import hide_unconfirmed
from ..query.objects.keeping import find_kept_objects
from ..query.scan_map import Map, load_map
from ..storage.manifest import Manifest, Upright, matrix
from ..storage.work_folder import WorkFolder
from ..storage.writer import MapParts, write_changed_map
from ..tracking.upright.lattice import find_lattice_origin
from ..tracking.upright.surface_patches import SurfacePatches, find_surface_patches
from ..tracking.upright.up_direction import turn_back
from ..tracking.upright.upright_frame import UprightFrame, find_upright_frame
from .adaptive_voxels import build_adaptive
from .box_refinement import lift_features_again, read_settings
from .map_redrawing import draw_pictures


def stand_upright(
    scan_map: Map, output: str | Path, *, overwrite: bool = False, progress: Progress | None = None
) -> Map:
    """Write the map, in the frame with z up, the floor at z = 0 and walls along x and y, to the folder ``output``.
    Raises MapError for a map that stands upright already, the map of a box, or an existing folder."""
    progress = progress or Progress()
    if scan_map.manifest.upright is not None:
        raise MapError(f"{scan_map.path} stands upright already.")
    if scan_map.manifest.refined is not None and scan_map.manifest.refined.box is not None:
        raise MapError(f"{scan_map.path} is the map of a box: let {scan_map.manifest.refined.map} stand upright first.")
    with WorkFolder.made_of(scan_map.path, Path(output), overwrite) as work:
        patches = _patches(scan_map)
        frame = find_upright_frame(_held(scan_map), patches)
        T, before = frame.T_upright_world, scan_map.trajectory
        trajectory = dataclasses.replace(before, T_world_cam=T @ before.T_world_cam)
        gaussians = anchors.align_gaussians(scan_map.gaussians, 1.0, T[:3, :3], T[:3, 3])
        occupancy = _build_occupancy(scan_map, gaussians, trajectory, patches.moved(T), progress)
        progress.stage("saving")
        parts = MapParts(
            _manifest(scan_map, frame),
            scan_map.settings,
            lambda: {**scan_map.report, "upright": frame.evidence()},
            occupancy,
            Codec.fit(scan_map.gaussian_features),
            scan_map.gaussian_features,
            gaussians,
            trajectory,
            draw=lambda folder: draw_pictures(scan_map, folder, trajectory, gaussians, np.array((0.0, 0.0, 1.0))),
            find_objects=find_kept_objects,
        )
        write_changed_map(scan_map, work, Path(output), parts)
    return load_map(output)


def _patches(scan_map: Map) -> SurfacePatches:
    return find_surface_patches(scan_map.keyframes.depth_images(), scan_map.trajectory.T_world_keyframe)


def _held(scan_map: Map) -> NDArray[np.float64]:
    """(K, 4, 4) poses of the keyframes as people held the camera, or as the images are if the capture is gone."""
    trajectory = scan_map.trajectory
    try:
        capture = scan_map.capture
    except FreeOccError:
        return trajectory.T_world_keyframe
    turned = np.array([capture.turned(index) for index in trajectory.keyframes.tolist()], np.int8)
    return turn_back(trajectory.T_world_keyframe, turned)


def _build_occupancy(
    scan_map: Map, gaussians: Gaussians, trajectory: Trajectory, patches: SurfacePatches, progress: Progress
) -> Occupancy:
    """Layer 4 in the upright frame, from the keyframes."""
    settings, poses = read_settings(scan_map), trajectory.T_world_keyframe
    features, options = scan_map.gaussian_features, settings.occupancy
    size, finest = scan_map.manifest.voxel_size_m, options.finest
    cell_size = settings.gaussians.cell_size or 0.5 * size

    progress.stage("occupancy", len(poses))
    occupancy = build.build_occupancy(
        gaussians,
        features,
        hide_unconfirmed(read_keyframes(scan_map, poses), gaussians, size, cell_size),
        options,
        settings.carving,
        origin=find_lattice_origin(patches, size),
        progress=progress.advance,
        least_scale=anchors.compute_least_scale(settings.gaussians, cell_size, size),
    )
    if finest is None:
        return occupancy

    def encode(more: Gaussians) -> NDArray[np.float16]:
        return lift_features_again(scan_map, scan_map.keyframes, poses, more, settings, progress)

    def posed() -> Iterator[PosedFrame]:
        return read_keyframes(scan_map, poses)

    return build_adaptive(occupancy, gaussians, features, posed, poses, encode, settings, finest, progress)


def read_keyframes(scan_map: Map, poses: NDArray[np.float64]) -> Iterator[PosedFrame]:
    """Yields the keyframes at (K, 4, 4) poses."""
    for row, (frame, T) in enumerate(zip(scan_map.keyframes, poses, strict=True)):
        yield PosedFrame(frame, T, row)


def _manifest(scan_map: Map, frame: UprightFrame) -> Manifest:
    said, T_map_upright = scan_map.manifest, invert(frame.T_upright_world)
    T_first_camera, upright = scan_map.T_first_camera, Upright(**frame.evidence())
    return msgspec.structs.replace(
        said,
        frame=upright.in_words,
        world=said.world or said.frame,
        up=(0.0, 0.0, 1.0),
        upright=upright,
        T_world_map=matrix(np.array(said.T_world_map) @ T_map_upright),
        T_first_camera=None if T_first_camera is None else matrix(T_first_camera @ T_map_upright),
        T_gravity_map=matrix(np.eye(4)),
    )
