"""Scales a map whose unit is unknown: by a known length, the cameras' height, or metric poses.

Every length in a map is proportional to its unit, so scaling is exact: poses, Gaussians with their anchors, edges and
origin of voxels, depth of keyframes. The rest (probabilities, features, images) is copied.
"""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from ..capture import associate, read_trajectory
from ..core.errors import FreeOccError, MapError
from ..core.transforms import back_project, transform
from ..core.types import Gaussians, Trajectory
from ..core.warnings import read_notices
from ..query.objects.keeping import find_kept_objects
from ..query.scan_map import Map, load_map
from ..settings.config import Settings
from ..storage import map_files
from ..storage.manifest import Manifest, MapScale, matrix, vector
from ..storage.work_folder import WorkFolder
from ..storage.writer import MapParts, write_changed_map
from ..tracking.trajectory_alignment import Poses, align_trajectories, read_poses, select_estimated_poses
from ..tracking.upright.upright_frame import find_flat_gaussians, find_upright_frame
from .map_redrawing import draw_pictures

_NEAR_PX = 6
_MOST_DEPTH_M = 65.535  # what 16 bits of millimeters hold
_LEAST_VOXEL_M = 0.001
_FITS = 0.1  # of the spread of the cameras: poses with a larger error belong to another scan


def scale_map(scan_map: Map, factor: float, by: str, output: str | Path, *, overwrite: bool = False) -> Map:
    """Write the map with every length times ``factor`` to the folder ``output``. Its lengths are then meters.

    by: the source of the factor, for the manifest. Raises MapError for an unusable factor or an existing folder.
    """
    if not (math.isfinite(factor) and factor > 0):
        raise MapError(f"The scale factor must be a positive number, got {factor:g}.")
    voxel = factor * scan_map.manifest.finest_m
    farthest = factor * max((float(scan_map.keyframes.depth_m(row).max()) for row in _rows(scan_map)), default=0.0)
    if voxel < _LEAST_VOXEL_M or farthest > _MOST_DEPTH_M:
        raise MapError(
            f"Times {factor:g}, voxels would have an edge of {voxel:.2g} m and depth would reach {farthest:.3g} m. A "
            f"map holds edges from {_LEAST_VOXEL_M:g} m and depth up to {_MOST_DEPTH_M:.0f} m: check the length."
        )
    with WorkFolder.made_of(scan_map.path, Path(output), overwrite) as work:
        trajectory = _trajectory(scan_map.trajectory, factor)
        gaussians = _gaussians(scan_map.gaussians, factor)
        report = _report(scan_map, factor)
        parts = MapParts(
            _manifest(scan_map, factor, by),
            _settings(scan_map, factor),
            lambda: report,
            gaussians=gaussians,
            trajectory=trajectory,
            keyframes=scan_map.keyframes,
            depth_factor=factor,
            draw=lambda folder: draw_pictures(scan_map, folder, trajectory, gaussians, scan_map.up, factor),
            find_objects=find_kept_objects,
        )
        write_changed_map(scan_map, work, Path(output), parts)
    return load_map(output)


def scale_by_length(scan_map: Map, ends: Sequence[str], meters: float) -> float:
    """The factor by which two points are ``meters`` apart.

    ends: each is ``FRAME:X,Y``, a pixel of a keyframe, or a word, for the centroid of the best region that it matches.
    Raises MapError for a frame that is no keyframe, a pixel without depth near it, a word without a match, or two equal
    points.
    """
    _require_meters(meters, "length")
    first, second = (_point(scan_map, end) for end in ends)
    length = float(np.linalg.norm(first - second))
    if length < 1e-6:
        raise MapError(f"{ends[0]} and {ends[1]} are the same point of the map: name two different points.")
    return meters / length


def scale_by_camera_height(scan_map: Map, meters: float) -> float:
    """The factor by which the median height of the keyframes above the floor is ``meters``. Raises MapError if the map
    shows no floor below them."""
    _require_meters(meters, "camera height")
    poses, upright = scan_map.trajectory.T_world_keyframe, scan_map.manifest.upright
    found = upright or find_upright_frame(poses, find_flat_gaussians(scan_map.gaussians, poses))
    if not found.floor:
        raise MapError(f"{scan_map.path} shows no floor below the cameras: give a known length instead (--length).")
    height = float(np.median(transform(scan_map.T_gravity_map, poses[:, :3, 3])[:, 2]))
    return meters / height


def scale_by_poses(scan_map: Map, path: str) -> float:
    """The factor by which the camera path fits metric poses: those of a capture, or of a file in any format that
    ``capture.read_trajectory`` knows. Raises FreeOccError if too few poses match, or the paths differ."""
    own = select_estimated_poses(scan_map.trajectory)
    metric = _metric_poses(scan_map, path)
    found = align_trajectories(own, metric, "sim3")
    rows, rows_metric = associate(own.timestamps, metric.timestamps)
    centers = metric.centers[rows_metric]
    off = float(np.median(np.linalg.norm(found.to_true(own.centers[rows]) - centers, axis=1)))
    spread = float(np.linalg.norm(centers - centers.mean(axis=0), axis=1).mean())
    if off > _FITS * spread:
        raise FreeOccError(
            f"The poses of {path} are not this map's: after alignment, half of the cameras are at least {off:.2f} m "
            f"apart, and the camera path spreads over {spread:.2f} m. Check its times or image names."
        )
    return found.scale


def _metric_poses(scan_map: Map, path: str) -> Poses:
    """The poses of a capture or file. If a file names images, the map's capture, which must exist, gives their
    times."""
    if Path(path).is_file() and (found := read_trajectory(path)).names:
        T = found.of_frames(capture := scan_map.capture)
        has_pose = np.isfinite(T).all(axis=(1, 2))
        return Poses(capture.timestamps[has_pose], T[has_pose])
    return read_poses(path)


def _point(scan_map: Map, end: str) -> NDArray[np.float64]:
    """(3,) in the map's frame."""
    match = re.fullmatch(r"(\d+):(\d+),(\d+)", end.strip())
    if match is None:
        result = scan_map.query(end)
        if not result.regions:
            raise MapError(
                f"'{end}' matches nothing in {scan_map.path}: name something else, or a keyframe's pixel, FRAME:X,Y."
            )
        return result.regions[0].centroid
    frame, x, y = map(int, match.groups())
    trajectory = scan_map.trajectory
    rows = np.flatnonzero(trajectory.keyframes == frame)
    if not len(rows):
        nearest = sorted(trajectory.keyframes.tolist(), key=lambda index: abs(index - frame))[:3]
        raise MapError(
            f"Frame {frame} is not a keyframe of {scan_map.path}; the nearest are "
            f"{', '.join(map(str, sorted(nearest)))}. Their images are in {scan_map.path / map_files.KEYFRAMES}."
        )
    depth_m, camera = scan_map.keyframes.depth_m(int(rows[0])), scan_map.keyframes.views()[int(rows[0])][1]
    if not (x < camera.width and y < camera.height):
        raise MapError(f"Pixel {x},{y} is outside keyframe {frame}: {camera.width} x {camera.height} pixels.")
    left, top = max(x - _NEAR_PX, 0), max(y - _NEAR_PX, 0)
    v, u = np.nonzero(depth_m[top : y + _NEAR_PX + 1, left : x + _NEAR_PX + 1])
    if not len(u):
        raise MapError(
            f"Keyframe {frame} has no depth within {_NEAR_PX} pixels of {x},{y}: choose a pixel on something textured."
        )
    nearest_px = int(np.argmin((u + left - x) ** 2 + (v + top - y) ** 2))
    z = float(depth_m[top + v[nearest_px], left + u[nearest_px]])
    point = back_project(np.array((x, y), np.float64), np.float64(z), camera)  # type: ignore[arg-type]
    return np.asarray(transform(trajectory.T_world_keyframe[rows[0]], point))


def _require_meters(value: float, what: str) -> None:
    if not (math.isfinite(value) and value > 0):
        raise MapError(f"The {what} must be a positive number of meters, got {value:g}.")


def _rows(scan_map: Map) -> range:
    return range(len(scan_map.keyframes))


def _moved(T: NDArray[np.float64], factor: float) -> NDArray[np.float64]:
    """(..., 4, 4) with the translations scaled."""
    out = np.array(T, np.float64)
    out[..., :3, 3] *= factor
    return out


def _trajectory(trajectory: Trajectory, factor: float) -> Trajectory:
    return dataclasses.replace(trajectory, T_world_cam=_moved(trajectory.T_world_cam, factor))


def _gaussians(gaussians: Gaussians, factor: float) -> Gaussians:
    lengths = {name: getattr(gaussians, name) * np.float32(factor) for name in ("means", "scales", "anchor_cam")}
    return dataclasses.replace(gaussians, **lengths)


def _settings(scan_map: Map, factor: float) -> Settings:
    """The map's own settings, with their sizes scaled."""
    settings = scan_map.settings
    for section, key in (("occupancy", "voxel_size"), ("occupancy", "finest"), ("gaussians", "cell_size")):
        value = getattr(getattr(settings, section), key)
        if value is not None:
            settings = settings.changed(section, **{key: value * factor})
    return settings


def _report(scan_map: Map, factor: float) -> dict[str, Any]:
    report = dict(scan_map.report)
    warnings = read_notices(report["warnings"])
    if not scan_map.metric and warnings and warnings[-1].code == "uncoded":
        warnings.pop()  # when warnings had no codes, the last one of a map of unknown scale said so
    report["warnings"] = [notice.to_dict() for notice in warnings if notice.code != "scale-unknown"]
    if (rendering := report.get("rendering")) and rendering.get("depth_l1_m") is not None:
        report["rendering"] = {**rendering, "depth_l1_m": rendering["depth_l1_m"] * factor}
    if check := report.get("check"):
        measures = {name: _scaled(measure, factor) for name, measure in check["measures"].items()}
        report["check"] = {**check, "measures": measures}
    return report


def _scaled(measure: dict[str, Any], factor: float) -> dict[str, Any]:
    """A measure of ``pipeline.map_check`` in a report; only lengths change."""
    if measure["unit"] != "m" or measure["value"] is None:
        return measure
    return {**measure, "value": measure["value"] * factor}


def _manifest(scan_map: Map, factor: float, by: str) -> Manifest:
    said = scan_map.manifest
    changes: dict[str, Any] = {
        "voxel_size_m": factor * said.voxel_size_m,
        "origin": vector(factor * np.array(said.origin)),
        "T_world_map": matrix(_moved(np.array(said.T_world_map), factor)),
        "scale": MapScale(metric=True, by=by, factor=said.scale.factor * factor),
    }
    if said.finest_voxel_m is not None:
        changes["finest_voxel_m"] = factor * said.finest_voxel_m
    for name in ("T_gravity_map", "T_first_camera"):
        if (T := getattr(said, name)) is not None:
            changes[name] = matrix(_moved(np.array(T), factor))
    if said.refined is not None and (box := said.refined.box) is not None:
        low, high = vector(factor * np.array(box[:3])), vector(factor * np.array(box[3:]))
        changes["refined"] = msgspec.structs.replace(said.refined, box=(*low, *high))
    return msgspec.structs.replace(said, **changes)
