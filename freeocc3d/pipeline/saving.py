"""The map of a finished run: its files, pictures, manifest and report."""

from __future__ import annotations

import dataclasses
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from ..core.transforms import invert
from ..core.types import Gaussians, Occupancy, Trajectory
from ..gaussians import rendered_views
from ..language.encoders.base import Encoder
from ..language.feature_codec import Codec
from ..query.chance import record_encoder
from ..query.objects.keeping import find_kept_objects
from ..storage import map_files
from ..storage.manifest import (
    CaptureRecord,
    MapFacts,
    MapScale,
    SceneWords,
    Upright,
    matrix,
)
from ..storage.work_folder import WorkFolder
from ..storage.writer import MapParts, write_map
from ..tracking.view_agreement import prepare_compared_views
from ..viewer import render_pictures, trajectory_picture
from .map_check import check_agreement
from .mapper import Mapper
from .report import report_of

_MEASURED_VIEWS = 24
"""Largest number of keyframes that are rendered to measure how well the Gaussians show the images."""


def save(
    work: WorkFolder,
    mapper: Mapper,
    trajectory: Trajectory,
    gaussians: Gaussians,
    features: NDArray[np.float16],
    occupancy: Occupancy,
    encoder: Encoder,
    vocabulary: dict[str, Any] | None,
    tracking_reason: str,
) -> None:
    """Write the map of a run into its work folder. Its time "check" is what the check takes longer than the rest."""
    capture, metric, submaps = mapper.capture, mapper.tracker.metric, mapper.submaps()
    settings = mapper.settings
    if not metric:  # states how fine its Gaussians are, for projections on other lattices
        settings = settings.changed("gaussians", cell_size=mapper.cell_size)

    def check() -> dict[str, Any]:
        held = [agrees for submap in submaps for agrees in submap.held.tolist()]
        compared = prepare_compared_views(mapper.mapped(trajectory))
        return check_agreement(compared, trajectory.T_world_keyframe, occupancy, held).summary()

    def draw(folder: Path) -> None:
        path, up = folder / map_files.PATH_PICTURE, np.array(facts.up)
        trajectory_picture.write_path_picture(path, submaps, trajectory, gaussians, up, capture.path, metric)
        rows = evenly(count, render_pictures.SHOWN)
        shown = list(zip(trajectory.keyframes[rows].tolist(), mapper.views(trajectory, rows), strict=True))
        picture = folder / map_files.RENDER_PICTURE
        render_pictures.write_render_picture(picture, gaussians, shown, mapper.rasterizer, capture.path, metric)

    with ThreadPoolExecutor(1) as pool:
        checking = pool.submit(check)  # while pictures are rendered and files are written

        def report() -> dict[str, Any]:
            with work.timed("check"):
                checked = checking.result()
            return {
                **report_of(work, mapper, trajectory, submaps, tracking_reason),
                "rendering": dataclasses.asdict(fidelity),
                "check": checked,
            }

        with work.timed("saving"):
            facts = _facts(mapper, trajectory, encoder, occupancy, vocabulary)
            count = len(trajectory.keyframes)
            measured = mapper.views(trajectory, evenly(count, _MEASURED_VIEWS))
            fidelity = rendered_views.measure_fidelity(gaussians, measured, mapper.rasterizer)
            codec = Codec.fit(features)
        parts = MapParts(
            facts, settings, report, occupancy, codec, features, gaussians, trajectory, mapper.mapped(trajectory),
            draw=draw, find_objects=lambda folder: find_kept_objects(folder, encoder),
        )  # fmt: skip
        write_map(work, parts)


def _facts(
    mapper: Mapper,
    trajectory: Trajectory,
    encoder: Encoder,
    occupancy: Occupancy,
    vocabulary: dict[str, Any] | None,
) -> MapFacts:
    capture = mapper.capture
    assert mapper.upright is not None  # refined
    upright = Upright(**mapper.upright.evidence())
    return MapFacts(
        capture=CaptureRecord(path=absolute(capture.path), format=capture.format, frames=len(capture)),
        frame=upright.in_words,
        world=mapper.tracker.world,
        scale=_scale(mapper),
        up=(0.0, 0.0, 1.0),
        upright=upright,
        T_world_map=matrix(invert(mapper.T_map_world)),
        T_first_camera=matrix(invert(trajectory.T_world_cam[np.flatnonzero(trajectory.has_pose)[0]])),
        T_gravity_map=matrix(np.eye(4)),
        encoder=record_encoder(encoder, occupancy),
        vocabulary=msgspec.convert(vocabulary, SceneWords) if vocabulary else None,
    )


def _scale(mapper: Mapper) -> MapScale:
    """Whether lengths are meters, the source of the scale, and meters per unit of the tracker."""
    capture, given = mapper.capture, mapper.capture.options.scale
    if not mapper.tracker.metric:
        return MapScale(metric=False, by="none", factor=1.0)
    by = "sensor" if capture.has_depth else "given" if given is not None else "poses"
    return MapScale(metric=True, by=by, factor=given or 1.0)


def evenly(count: int, wanted: int) -> list[int]:
    """Up to ``wanted`` of ``count`` rows, evenly spread, none at the very ends if there are enough."""
    return [int((n + 0.5) * count / min(wanted, count)) for n in range(min(wanted, count))]


def absolute(path: Path) -> str:
    return str(path) if str(path).startswith("builtin:") else str(path.resolve())
