"""A map with the words of another model: its keyframes are encoded anew, all else stays."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec

from ..core.errors import MapError
from ..core.progress import Progress
from ..gaussians import anchors
from ..language import lifting
from ..language.encoders.base import Encoder
from ..language.feature_codec import Codec
from ..language.model_packages import Package
from ..language.word_models import use_package
from ..occupancy import build
from ..query.chance import record_encoder
from ..query.objects.keeping import find_kept_objects
from ..query.scan_map import Map, load_map
from ..storage.work_folder import WorkFolder
from ..storage.writer import MapParts, write_changed_map
from .box_refinement import read_settings


def relabel_map(
    scan_map: Map,
    package: Package,
    output: str | Path,
    *,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> Map:
    """Write the map, with the words that a model package understands, to the folder ``output``. Raises FreeOccError for
    a map of several voxel sizes, which does not hold the Gaussians of the smaller ones, or an existing folder."""
    progress = progress or Progress()
    occupancy = scan_map.occupancy
    if occupancy.deepest:
        raise MapError(
            f"{scan_map.path} has voxels of several sizes: relabel the map that it was made from, and refine that."
        )
    settings = use_package(read_settings(scan_map), package)
    encoder: Encoder = settings.load_backend("language", None)
    with WorkFolder.made_of(scan_map.path, Path(output), overwrite) as work:
        gaussians, T = scan_map.gaussians, scan_map.trajectory.T_world_keyframe
        with work.timed("language"):
            features = lifting.lift_features(gaussians, scan_map.keyframes, T, encoder, settings.language, progress)
        progress.stage("occupancy")
        splatting = settings.occupancy.changed(voxel_size=occupancy.voxel_size)
        cell = settings.gaussians.cell_size or 0.5 * settings.occupancy.voxel_size
        scale = anchors.compute_least_scale(settings.gaussians, cell, occupancy.voxel_size)
        with work.timed("occupancy"):
            voxels = build.compute_features(occupancy, gaussians, features, splatting, scale)
        progress.stage("saving")
        relabeled = dataclasses.replace(occupancy, features=voxels)
        with work.timed("words"):
            record = record_encoder(encoder, relabeled)
        parts = MapParts(
            msgspec.structs.replace(scan_map.manifest, encoder=record),
            settings,
            lambda: _report(scan_map, work.seconds),
            relabeled,
            Codec.fit(features),
            features,
            find_objects=lambda folder: find_kept_objects(folder, encoder),
        )
        write_changed_map(scan_map, work, Path(output), parts)
    return load_map(output)


def _report(scan_map: Map, seconds: Mapping[str, float]) -> dict[str, Any]:
    """The report of the run that made the map, but for the time of the features that are gone, with the time that the
    new ones took."""
    kept = {stage: value for stage, value in scan_map.report["seconds"].items() if stage not in ("language", "objects")}
    own = {stage: round(value, 3) for stage, value in seconds.items()}
    return {**scan_map.report, "seconds": kept, "relabeled": {"map": str(scan_map.path), "seconds": own}}
