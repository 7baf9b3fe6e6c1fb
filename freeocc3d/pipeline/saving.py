"""The map of a finished run: its files, pictures, manifest and report."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .. import __version__
from ..core.tum_files import write_tum
from ..core.types import Gaussians, Occupancy, Submap, Trajectory
from ..gaussians import rendered_views
from ..language.encoders.base import Encoder
from ..language.feature_codec import Codec
from ..occupancy.gravity_frame import estimate_gravity_frame
from ..occupancy.up_direction import estimate_up, turn_back
from ..settings import config
from ..storage import store
from ..storage.work_folder import WorkFolder
from ..viewer import render_pictures, trajectory_picture
from .mapper import Mapper
from .report import report_of

_MEASURED_VIEWS = 24
"""Keyframes, at most, that are rendered to say how well the Gaussians show what was captured."""


def save(
    work: WorkFolder,
    mapper: Mapper,
    trajectory: Trajectory,
    gaussians: Gaussians,
    features: NDArray[np.float16],
    occupancy: Occupancy,
    encoder: Encoder,
    vocabulary: dict[str, Any] | None,
) -> None:
    capture, keyframes = mapper.capture, mapper.mapped(trajectory)
    submaps = mapper.tracker.submaps()
    folder = work.folder
    with work.timed("saving"):
        codec = Codec.fit(features)
        store.write_occupancy(folder, occupancy, codec, features)
        write_tum(folder / store.TRAJECTORY, trajectory)
        settings = mapper.settings
        if not mapper.tracker.metric:  # says how fine its Gaussians are when the map is put on other lattices
            settings = settings.changed("gaussians", cell_size=mapper.cell_size)
        (folder / store.CONFIG).write_text(config.dump(settings), encoding="utf-8")
        metric = mapper.tracker.metric
        manifest = _manifest(mapper, trajectory, gaussians, occupancy, encoder, submaps)
        up = np.array(manifest["up"])
        trajectory_picture.write_path_picture(
            folder / store.PATH_PICTURE, submaps, trajectory, gaussians, up, capture.path, metric
        )
        views = list(zip(trajectory.keyframes.tolist(), mapper.views(trajectory), strict=True))
        shown = [views[row] for row in evenly(len(views), render_pictures.SHOWN)]
        picture = folder / store.RENDER_PICTURE
        render_pictures.write_render_picture(picture, gaussians, shown, mapper.rasterizer, capture.path, metric)
        measured = [views[row][1] for row in evenly(len(views), _MEASURED_VIEWS)]
        fidelity = rendered_views.measure_fidelity(gaussians, measured, mapper.rasterizer)
        if len(keyframes) < len(mapper.keyframes):
            work.forget_tracking()  # it counts those that are left out from here on
        keyframes.save_index()
        keyframes.drop_unlisted()
    report = {**report_of(work, capture, trajectory, submaps), "rendering": dataclasses.asdict(fidelity)}
    (folder / store.REPORT).write_text(json.dumps(report), encoding="utf-8")
    store.write_manifest(folder, {**manifest, **({"vocabulary": vocabulary} if vocabulary else {})})


def _manifest(
    mapper: Mapper,
    trajectory: Trajectory,
    gaussians: Gaussians,
    occupancy: Occupancy,
    encoder: Encoder,
    submaps: list[Submap],
) -> dict[str, Any]:
    capture = mapper.capture
    turned = np.array([capture.turned(index) for index in trajectory.keyframes.tolist()], np.int8)
    held = turn_back(trajectory.T_world_keyframe, turned)
    return {
        "freeocc3d": __version__,
        "capture": {"path": absolute(capture.path), "format": capture.format, "frames": len(capture)},
        "frame": mapper.tracker.world,
        "poses": "camera to world",
        **store.sizes(occupancy),
        "origin": occupancy.origin.tolist(),
        "scale": _scale(mapper),
        "up": estimate_up(held, gaussians.means).tolist(),
        "T_world_map": np.eye(4).tolist(),
        "T_gravity_map": estimate_gravity_frame(held, gaussians).tolist(),
        "encoder": {"name": encoder.name, "dimension": encoder.dimension, "state": encoder.text_state()},
        "codec": "transform coding, 8, 4 and 2 bits a direction",
        "counts": {
            "gaussians": len(gaussians),
            "voxels": store.counts(occupancy),
            "frames": len(trajectory),
            "frames_with_pose": int(trajectory.has_pose.sum()),
            "submaps": len(submaps),
        },
        "keyframes": trajectory.keyframes.tolist(),
    }


def _scale(mapper: Mapper) -> dict[str, Any]:
    """Whether lengths are metres, what says so, and how many a unit of what the tracker gives is."""
    capture, given = mapper.capture, mapper.capture.options.scale
    if not mapper.tracker.metric:
        return {"metric": False, "by": "none", "factor": 1.0}
    by = "sensor" if capture.has_depth else "given" if given is not None else "poses"
    return {"metric": True, "by": by, "factor": given or 1.0}


def evenly(count: int, wanted: int) -> list[int]:
    """At most ``wanted`` of ``count`` rows, evenly spread, none at the very ends if there are enough."""
    return [int((n + 0.5) * count / min(wanted, count)) for n in range(min(wanted, count))]


def absolute(path: Path) -> str:
    return str(path) if str(path).startswith("builtin:") else str(path.resolve())
