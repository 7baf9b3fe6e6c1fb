"""Writes a map folder: every part, and last the manifest, into a work folder that then takes the map's name."""

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
    """The parts of a map to write. If a part is None, its files and its manifest entries come from the source map.

    facts: what only the manifest states; for a map made from another map, the changed manifest of that map.
    report: returns the content of report.json; called last, since the content may include the time of saving.
    codec: packs the features of the voxels and of the Gaussians.  features: (N, D) of the Gaussians.
    keyframes: those of the trajectory. If they already lie in the work folder, images of other frames are removed.
    draw: draws pictures into a folder, or none.
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
    """Multiplies the depth of copied keyframes."""
    draw: Callable[[Path], None] | None = None


def write_changed_map(source: SavedMap, work: WorkFolder, output: Path, parts: MapParts) -> None:
    """Write a map that is made from another one. Raises MapError if that fails; nothing is left then."""
    with work.begun_anew(output):
        write_map(work, parts, source)
        work.finish(output)


def write_map(work: WorkFolder, parts: MapParts, source: SavedMap | None = None) -> None:
    """Write a whole map into the work folder, the manifest last. ``WorkFolder.finish`` then gives it its name.
    Gaussians and keyframes that a stage of the run has left there are not written again.

    source: the map that this one is made from. Raises OSError, and MapError for a broken keyframe of the source."""
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
        work.forget_tracking()  # its checkpoint counts the keyframes that are now left out
    keyframes.save_index()
    keyframes.drop_unlisted()


def _copy_missing(source: Path, folder: Path, pictures: bool) -> None:
    """Copy the files that were not written, except the report."""
    for name in (*map_files.ALWAYS, *(map_files.PICTURES if pictures else ())):
        if name != map_files.REPORT and not (folder / name).exists() and (source / name).is_file():
            shutil.copy2(source / name, folder / name)
    if not (folder / map_files.KEYFRAMES).exists():
        shutil.copytree(source / map_files.KEYFRAMES, folder / map_files.KEYFRAMES)


def _manifest(folder: Path, parts: MapParts, report: Mapping[str, Any]) -> Manifest:
    """The facts, changed by the parts that are written."""
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
