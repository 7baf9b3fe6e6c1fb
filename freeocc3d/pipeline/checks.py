"""What is checked before a run, and what its user is warned of."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ..capture import Capture
from ..core.types import Trajectory
from ..core.warnings import Notice
from ..editing import adaptive_voxels
from ..language import scene_vocabulary
from ..occupancy import splat
from ..settings.config import Settings

_FEW_TRACKED = 0.5


def check(settings: Settings) -> None:
    """Check before any work what a configuration asks of this machine: packages, files, devices, servers.

    A backend that needs more than packages has a function ``check``. Raises ConfigError, DependencyError for a backend
    whose packages are not installed, or what ``check`` raises.
    """
    if settings.occupancy.finest is not None:
        adaptive_voxels.count_halvings(settings.occupancy.voxel_size, settings.occupancy.finest)
    splat.check(settings.occupancy)
    scene_vocabulary.load_namer(settings.vocabulary)
    for section in ("tracking", "fitting", "language"):
        backend, options = settings.backend(section)
        if hasattr(backend, "check"):
            backend.check(options)


def warn_of_camera(capture: Capture) -> Notice:
    """That nothing says what the camera is."""
    focal = "what the images roughly state" if capture.focal_stated else "a guess"
    return Notice(
        "intrinsics-unknown",
        f"Nothing says what camera took {capture.path}: its focal length is {focal}, and what is mapped is bent as "
        "far as that is wrong. Give capture.intrinsics, if you have them.",
    )


def warn_of_color_focal(capture: Capture, ratio: float) -> Notice:
    """That the color camera's focal length is ``ratio`` times what the capture says."""
    return Notice(
        "color-focal-corrected",
        f"Color and depth of {capture.path} fit each other only if the color camera's focal length is "
        f"{ratio:.3f} of what its files say: color is resampled so (capture.color_focal=1 leaves it as it is).",
    )


def warn_of_scale() -> Notice:
    """That lengths are not in meters."""
    return Notice(
        "scale-unknown",
        "The scale of this map is unknown: its lengths, also the edge of its voxels, are in a unit in which the scene "
        "is about 2 deep. Give meters per unit with --scale, or scale the map by a known length: freeocc3d scale.",
    )


def warn_of_trajectory(trajectory: Trajectory) -> Iterator[Notice]:
    """That the map shows only part of the scan: frames that could not be read, were lost, or are submaps apart."""
    used = max(int(np.count_nonzero(trajectory.status != "unused")), 1)
    if broken := int(np.count_nonzero(trajectory.status == "broken")):
        text = (
            f"{_frames(broken)} could not be read and {'were' if broken > 1 else 'was'} skipped; report.json says why."
        )
        yield Notice("broken-frames", text)
    if len(lost := np.flatnonzero(trajectory.status == "lost")):
        share = len(lost) / used
        text = (
            f"Tracking lost {_frames(len(lost))} ({share:.0%}), the first is frame {lost[0]}: what only these show is "
            "not in the map."
        )
        if share > _FEW_TRACKED:
            text += " Most of the scan is missing: was it captured slowly, with depth in most of each image?"
        yield Notice("frames-lost", text)
    if len(apart := np.flatnonzero(trajectory.status == "apart")):
        yield Notice(
            "submaps-apart",
            f"{len(apart)} frames ({len(apart) / used:.0%}), the first is frame {apart[0]}, were tracked, but nothing "
            "ties them to the rest: they are submaps of their own and not in the map, which is of the largest.",
        )


def _frames(count: int) -> str:
    return f"{count} frame{'s' if count > 1 else ''}"
