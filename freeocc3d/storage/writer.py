"""Writes a map folder: every part, and last the manifest, into a work folder that then takes the map's name."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path, PurePath
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from .. import __version__
from ..core.atomic_files import sync
from ..core.checksums import hash_file
from ..core.errors import MapError
from ..core.tum_files import write_tum
from ..core.types import FREE, OCCUPIED, UNKNOWN, Gaussians, Occupancy, Trajectory
from ..gaussians.point_cloud import write_gaussian_ply
from ..language.feature_codec import Codec
from ..settings import config
from ..settings.config import Settings
from . import map_files
from .keyframes import INDEX, Keyframes
from .manifest import Manifest, MapCounts, MapFacts, VoxelCounts, vector, write_manifest
from .objects_file import ObjectArrays, write_objects
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
    find_objects: finds the objects of the written map in a folder, or None if the map keeps none.
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
    find_objects: Callable[[Path], ObjectArrays | None] | None = None


def write_changed_map(source: SavedMap, work: WorkFolder, output: Path, parts: MapParts) -> None:
    """Write a map that is made from another one. Raises OSError, MapError."""
    write_map(work, parts, source)
    work.finish(output)


def write_map(work: WorkFolder, parts: MapParts, source: SavedMap | None = None) -> None:
    """Write a whole map into the work folder, the manifest last. ``WorkFolder.finish`` then gives it its name.
    Gaussians and keyframes that a stage of the run has left there are not written again.

    source: the map that this one is made from. Raises OSError, and MapError for a damaged file of the source."""
    folder = work.folder
    for name in (map_files.MANIFEST, map_files.OBJECTS):  # of an earlier try
        (folder / name).unlink(missing_ok=True)
    with work.timed("saving"):
        (folder / map_files.CONFIG).write_text(config.dump(parts.settings), encoding="utf-8")
        _write_arrays(folder, parts)
        if parts.trajectory is not None:
            write_tum(folder / map_files.TRAJECTORY, parts.trajectory)
        if parts.draw is not None:
            parts.draw(folder)
        if parts.keyframes is not None:
            _write_keyframes(folder / map_files.KEYFRAMES, parts.keyframes, parts.depth_factor)
        copied = [] if source is None else _copy_missing(source.path, folder, pictures=parts.draw is None)
    manifest = _write_facts(folder, parts, None)
    if source is not None:
        _require_equal(source, manifest, copied, parts.depth_factor)
    if parts.find_objects is not None:
        with work.timed("objects"):
            objects = parts.find_objects(folder)
            if objects is not None:
                write_objects(folder / map_files.OBJECTS, objects)
        _write_facts(folder, parts, objects)
    sync(folder / map_files.MANIFEST)


def _write_facts(folder: Path, parts: MapParts, objects: ObjectArrays | None) -> Manifest:
    """Write the report and the manifest of the files that lie in the folder."""
    report = parts.report()
    (folder / map_files.REPORT).write_text(json.dumps(report), encoding="utf-8")
    manifest = _manifest(folder, parts, report, objects)
    write_manifest(folder, manifest)
    return manifest


def _write_arrays(folder: Path, parts: MapParts) -> None:
    if parts.codec is not None and parts.occupancy is not None and parts.features is not None:
        write_occupancy(folder, parts.occupancy, parts.codec)
        write_features(folder, parts.codec, parts.features)
    if parts.gaussians is not None and not (folder / map_files.GAUSSIANS).is_file():
        write_gaussian_ply(parts.gaussians, folder / map_files.GAUSSIANS)


def _write_keyframes(folder: Path, keyframes: Keyframes, depth_factor: float) -> None:
    if keyframes.folder == folder:
        keyframes.save_index()
    else:
        keyframes.copy_to(folder, depth_factor)


def _copy_missing(source: Path, folder: Path, pictures: bool) -> list[str]:
    """Copy the files that were not written, except the report. Returns their names, without those of keyframes."""
    copied = []
    for name in (*map_files.ALWAYS, *(map_files.PICTURES if pictures else ())):
        if name != map_files.REPORT and not (folder / name).exists() and (source / name).is_file():
            shutil.copy2(source / name, folder / name)
            copied.append(name)
    if not (folder / map_files.KEYFRAMES).exists():
        Keyframes.load(source / map_files.KEYFRAMES).copy_to(folder / map_files.KEYFRAMES)
    return copied


def _require_equal(source: SavedMap, made: Manifest, copied: list[str], depth_factor: float) -> None:
    """Raise MapError if a copied file is not as the source map states it."""
    images = "" if depth_factor == 1 else ".color.jpg"
    found, stated = made.checksums or {}, source.manifest.checksums or {}
    copied = [*copied, *(name for name in found if PurePath(name).match(f"{map_files.KEYFRAMES}/*{images}"))]
    for name in copied:
        if not name.endswith(INDEX) and stated.get(name, found[name]) != found[name]:
            raise MapError(f"{source.path / name} is damaged: its checksum is not the stated one. Copy the map again.")


def _manifest(folder: Path, parts: MapParts, report: Mapping[str, Any], objects: ObjectArrays | None) -> Manifest:
    """The facts, changed by the parts that are written."""
    said: dict[str, Any] = {name: getattr(parts.facts, name) for name in parts.facts.__struct_fields__}
    said["objects"] = None if objects is None else len(objects)
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
    names = [*_file_names(folder), *([map_files.OBJECTS] * (objects is not None))]
    said.update(freeocc3d=__version__, counts=MapCounts(**counts), files=_file_sizes(folder, names))
    said.update(checksums=_checksums(folder, names))
    return Manifest(**said)


def count_voxels(occupancy: Occupancy) -> VoxelCounts:
    """Numbers of voxels of each state."""
    of = {state: int(np.count_nonzero(occupancy.state == state)) for state in (OCCUPIED, FREE, UNKNOWN)}
    return VoxelCounts(occupied=of[OCCUPIED], free=of[FREE], unknown=of[UNKNOWN])


def _file_names(folder: Path) -> list[str]:
    """The files of the map in the folder, but for the manifest. Other images of keyframes are not the map's."""
    pictures = [name for name in map_files.PICTURES if (folder / name).is_file()]
    images = Keyframes.load(folder / map_files.KEYFRAMES).paths()
    keyframes = [folder / map_files.KEYFRAMES / INDEX, *images]
    return [*map_files.ALWAYS, *pictures, *sorted(path.relative_to(folder).as_posix() for path in keyframes)]


def _file_sizes(folder: Path, names: list[str]) -> dict[str, int]:
    return {name: (folder / name).stat().st_size for name in names}


def _checksums(folder: Path, names: list[str]) -> dict[str, str]:
    """The files' checksums, when they are on the disk."""
    for name in names:
        sync(folder / name)
    return {name: hash_file(folder / name) for name in names}
