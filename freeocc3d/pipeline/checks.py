"""What is checked before a run, and what a user is warned of after it."""

from __future__ import annotations

import numpy as np

from ..core.progress import Progress
from ..core.types import Trajectory
from ..depth import multi_view_stereo
from ..editing import adaptive_voxels
from ..gaussians import anchors, fitting
from ..language import lifting, scene_vocabulary
from ..occupancy import carve, splat
from ..settings import config, registry
from ..settings.config import Config
from ..storage.work_folder import WorkFolder
from .backends import options_of

_FEW_TRACKED = 0.5


def check(settings: Config) -> None:
    """Build the options of every layer and of the chosen backends, so that a value out of range is told before any
    work. A backend that needs more than packages has a function ``check``. Raises ConfigError, DependencyError for a
    backend whose packages are not installed, or what ``check`` raises."""
    layers = {"gaussians": anchors, "fitting": fitting, "language": lifting, "occupancy": splat, "carving": carve}
    for section, module in layers.items():
        options_of(module, config.options(settings, section))
    if settings["occupancy"]["finest"] is not None:
        adaptive_voxels.count_halvings(settings["occupancy"]["voxel_size"], settings["occupancy"]["finest"])
    scene_vocabulary.load_namer(options_of(scene_vocabulary, settings["vocabulary"]))
    options_of(multi_view_stereo, settings["tracking"]["stereo"])
    for section, key in (("tracking", "backend"), ("fitting", "rasterizer"), ("language", "encoder")):
        name = settings[section][key]
        backend = registry.load(str(config.SECTIONS[section][1]), name)
        if hasattr(backend, "Options"):
            options = options_of(backend, settings[section].get(name, {}))
            if hasattr(backend, "check"):
                backend.check(options)


def warn_of_result(trajectory: Trajectory, progress: Progress, work: WorkFolder) -> None:
    """Warn about a run whose map shows only part of the scan."""
    if work.broken:
        count = len(work.broken)
        text = f"{count} frame{'s' if count > 1 else ''} could not be read and were skipped; report.json says why."
        work.warnings.append(text)
        progress.warn(text)
    used = trajectory.status != "unused"
    lost = int(np.count_nonzero(trajectory.status == "lost"))
    if lost:
        share = lost / max(int(np.count_nonzero(used)), 1)
        first = int(np.flatnonzero(trajectory.status == "lost")[0])
        frames = f"{lost} frame{'s' if lost > 1 else ''} ({share:.0%})"
        text = f"Tracking lost {frames}, the first is frame {first}: what only these show is not in the map."
        if share > _FEW_TRACKED:
            text += " Most of the scan is missing: was it captured slowly, with depth in most of each image?"
        work.warnings.append(text)
        progress.warn(text)
    apart = np.flatnonzero(trajectory.status == "apart")
    if len(apart):
        share = len(apart) / max(int(np.count_nonzero(used)), 1)
        text = (
            f"{len(apart)} frames ({share:.0%}), the first is frame {apart[0]}, were tracked, but nothing ties them to "
            "the rest: they are submaps of their own and not in the map, which is of the largest."
        )
        work.warnings.append(text)
        progress.warn(text)
