"""Writing a map folder: every part, the manifest last, in a work folder that then takes the map's name."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from .. import __version__
from ..core.tum_files import write_tum
from ..core.types import FREE, OCCUPIED, UNKNOWN, Gaussians, Occupancy, Trajectory
from ..gaussians.point_cloud import write_gaussian_ply
from ..language.feature_codec import Codec
from ..settings import config
from ..settings.config import Settings
from . import map_files
from .keyframes import Keyframes
from .manifest import Manifest, MapCounts, MapFacts, VoxelCounts, vector, write_manifest
from .occupancy_file import write_features, write_occupancy
from .saved_map import SavedMap
from .work_folder import WorkFolder


@dataclass(frozen=True)
class MapParts:
    """What a map is written of. A part that is None is that of the map that this one is made from: its files are
    copied, and what the manifest says of it stays.

    facts: what only the manifest says; in a map that is made from another one that map's manifest, changed.
    report: gives what report.json holds; called last, for it may say how long saving took.
    codec: packs the features of the voxels and of the Gaussians.  features: (N, D) of the Gaussians.
    keyframes: those of the trajectory; where they lie in the work folder already, images of others are removed.
    draw: draws pictures into a folder, or leaves it without any.
    """

    facts: MapFacts
    settings: Settings
    report: Callable[[], Mapping[str, Any]]
    occupancy: Occupancy | None = None
    codec: Codec | None = None
    features: NDArray[np.float16] | None = None
    gaussians: Gaussians | None = None
    trajectory: Trajectory | None = None
    keyframes: Keyframes | None = None
    depth_factor: float = 1.0
    """Of the depth of keyframes that are copied."""
    draw: Callable[[Path], None] | None = None


def write_changed_map(source: SavedMap, work: WorkFolder, output: Path, parts: MapParts) -> None:
    """Write a map that is made from another one. Raises MapError where it cannot be written; nothing is left then."""
    with work.begun_anew(output):
        write_map(work, parts, source)
        work.finish(output)


def write_map(work: WorkFolder, parts: MapParts, source: SavedMap | None = None) -> None:
    """Write a whole map into the work folder, the manifest last, after which ``WorkFolder.finish`` gives it its name.
    Gaussians and keyframes that a stage of the run has left there are not written again.

    source: the map that this one is made from. Raises OSError, and MapError for a broken keyframe of the source.
    """
    folder = work.folder
    with work.timed("saving"):
        (folder / map_files.CONFIG).write_text(config.dump(parts.settings), encoding="utf-8")
        _write_arrays(folder, parts)
        if parts.trajectory is not None:
            write_tum(folder / map_files.TRAJECTORY, parts.trajectory)
        if parts.draw is not None:
            parts.draw(folder)
        if parts.keyframes is not None:
            _write_keyframes(work, parts.keyframes, parts.depth_factor)
        if source is not None:
            _copy_missing(source.path, folder, pictures=parts.draw is None)
    report = parts.report()
    (folder / map_files.REPORT).write_text(json.dumps(report), encoding="utf-8")
    write_manifest(folder, _manifest(folder, parts, report))


def _write_arrays(folder: Path, parts: MapParts) -> None:
    if parts.codec is not None and parts.occupancy is not None and parts.features is not None:
        write_occupancy(folder, parts.occupancy, parts.codec)
        write_features(folder, parts.codec, parts.features)
    if parts.gaussians is not None and not (folder / map_files.GAUSSIANS).is_file():
        write_gaussian_ply(parts.gaussians, folder / map_files.GAUSSIANS)


def _write_keyframes(work: WorkFolder, keyframes: Keyframes, depth_factor: float) -> None:
    folder = work.folder / map_files.KEYFRAMES
    if keyframes.folder != folder:
        keyframes.copy_to(folder, depth_factor)
        return
    if len(keyframes) < len(Keyframes.load(folder)):
        work.forget_tracking()  # its checkpoint counts those that are left out from here on
    keyframes.save_index()
    keyframes.drop_unlisted()


def _copy_missing(source: Path, folder: Path, pictures: bool) -> None:
    """Copy what was not written anew, but for the report."""
    for name in (*map_files.ALWAYS, *(map_files.PICTURES if pictures else ())):
        if name != map_files.REPORT and not (folder / name).exists() and (source / name).is_file():
            shutil.copy2(source / name, folder / name)
    if not (folder / map_files.KEYFRAMES).exists():
        shutil.copytree(source / map_files.KEYFRAMES, folder / map_files.KEYFRAMES)


def _manifest(folder: Path, parts: MapParts, report: Mapping[str, Any]) -> Manifest:
    """The facts, and what the parts that are written anew change."""
    said: dict[str, Any] = {name: getattr(parts.facts, name) for name in parts.facts.__struct_fields__}
    counts: dict[str, Any] = msgspec.structs.asdict(said["counts"]) if "counts" in said else {}
    if "submaps" in report:
        counts["submaps"] = len(report["submaps"])
    if (occupancy := parts.occupancy) is not None:
        said["voxel_size_m"] = occupancy.voxel_size
        said["finest_voxel_m"] = occupancy.finest if occupancy.deepest else None
        said["origin"] = vector(occupancy.origin)
        counts["voxels"] = count_voxels(occupancy)
    if parts.gaussians is not None:
        counts["gaussians"] = len(parts.gaussians)
    if (trajectory := parts.trajectory) is not None:
        said["keyframes"] = tuple(trajectory.keyframes.tolist())
        counts.update(frames=len(trajectory), frames_with_pose=int(trajectory.has_pose.sum()))
    said.update(freeocc3d=__version__, counts=MapCounts(**counts), files=_file_sizes(folder))
    return Manifest(**said)


def count_voxels(occupancy: Occupancy) -> VoxelCounts:
    """Numbers of voxels of each state."""
    of = {state: int(np.count_nonzero(occupancy.state == state)) for state in (OCCUPIED, FREE, UNKNOWN)}
    return VoxelCounts(occupied=of[OCCUPIED], free=of[FREE], unknown=of[UNKNOWN])


def _file_sizes(folder: Path) -> dict[str, int]:
    pictures = [name for name in map_files.PICTURES if (folder / name).is_file()]
    paths = [folder / name for name in (*map_files.ALWAYS, *pictures)]
    paths += sorted((folder / map_files.KEYFRAMES).iterdir())
    return {path.relative_to(folder).as_posix(): path.stat().st_size for path in paths}
