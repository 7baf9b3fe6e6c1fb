"""The checks before a run, and the warnings that its user gets."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np

from ..capture import Capture
from ..core.image_files import Size
from ..core.types import Frame, Trajectory
from ..core.warnings import Notice
from ..editing import adaptive_voxels
from ..language import scene_vocabulary
from ..occupancy import splat
from ..settings.config import Settings
from .frame_losses import DARK
from .tracking_choice import AUTO

_FEW_TRACKED = 0.5

_FOCALS = {"Kinect or PrimeSense": 0.82, "RealSense D400": 0.96, "iPhone": 0.78}
_WIDE_FOCALS = {"RealSense D400": 0.72, "Azure Kinect": 0.48, "iPhone": 0.75}
"""Focal lengths of usual sensors over the width, for images of 4:3 and of 16:9."""


def check(settings: Settings) -> None:
    """Check, before any work, that this machine has what a configuration needs: packages, files, devices, servers.

    A backend that needs more than packages has a function ``check``. Raises ConfigError, DependencyError for a missing
    package, or what ``check`` raises.
    """
    if settings.occupancy.finest is not None:
        adaptive_voxels.count_halvings(settings.occupancy.voxel_size, settings.occupancy.finest)
    splat.check(settings.occupancy)
    scene_vocabulary.load_namer(settings.vocabulary)
    for section in ("tracking", "fitting", "language"):
        if settings.chosen(section) == AUTO:  # chosen when the capture is open
            continue
        backend, options = settings.backend(section)
        if hasattr(backend, "check"):
            backend.check(options)


def check_projection(settings: Settings) -> Notice | None:
    """A warning if the projection misses the Gaussians' shape: thin discs mostly lie beside the centers of voxels."""
    projection = settings.occupancy.projection
    if settings.gaussians.initialization != "disc" or projection not in ("probabilistic", "poisson"):
        return None
    return Notice(
        "options-unsuited",
        f"occupancy.projection={projection} looks at the centers of voxels only, and discs (gaussians.initialization) "
        "are thinner than voxels, so most of the surface will be missing: give gaussians.initialization=ray_aligned, "
        "too.",
    )


def check_brightness(frames: Sequence[Frame], path: Path) -> Notice | None:
    """A warning if most of some frames of a capture are nearly black."""
    bright = [float(np.percentile(cv2.cvtColor(frame.color, cv2.COLOR_RGB2GRAY), 95)) for frame in frames]
    dark = [one for one in bright if one < DARK]
    if 2 * len(dark) <= len(bright):
        return None
    return Notice(
        "images-dark",
        f"{len(dark)} of {len(bright)} color images of {path} that were looked at are nearly black (95 % of their "
        f"pixels below {np.median(dark):.0f} of 255): depth alone tells the poses, and the map has hardly any colors.",
    )


def warn_of_camera(capture: Capture) -> Notice:
    """Warns that the camera is unknown."""
    focal = "the rough value of the images" if capture.focal_stated else "a guess"
    return Notice(
        "intrinsics-unknown",
        f"The camera of {capture.path} is unknown: its focal length is {focal}, and an error in it bends the map. "
        "Give capture.intrinsics if you know them.",
    )


def warn_of_estimated_focal(capture: Capture, focal_px: float, uncertainty: float) -> Notice:
    """Warns that the scan itself told the focal length, ``focal_px`` in pixels of the stored color images."""
    return Notice(
        "focal-estimated",
        f"Nothing states the camera of {capture.path}. The scan shows a focal length of {focal_px:.0f} pixels "
        f"(± {max(uncertainty, 0.01):.0%}), which is used: give --focal if you know it better.",
    )


def explain_unknown_camera(capture: Capture, size: Size, roughly: str = "") -> str:
    """Says that nothing tells the focal length, and what to give. size: of the stored color images.  roughly: what the
    scan shows of it, such as "121 ± 6 %"; empty if nothing."""
    width = max(size)
    wide = max(size) > 1.5 * min(size)
    usual = ", ".join(f"{name} {ratio * width:.0f}" for name, ratio in (_WIDE_FOCALS if wide else _FOCALS).items())
    return (
        f"Nothing states the camera of {capture.path}{_folders(capture)}, and the scan shows "
        f"{f'its focal length only roughly, {roughly}' if roughly else 'too little to estimate its focal length'}: "
        f"give --focal with the focal length of its color images in pixels (usual for {size[0]} x {size[1]}: {usual})."
    )


def _folders(capture: Capture) -> str:
    """Where its color and depth lie, for messages; empty if they are not in folders of their own."""
    files = capture.files(0)
    names = [file.parent.name for file in files[:2] if file.parent != capture.path]
    return f" (color in {names[0]}/, depth in {names[1]}/)" if len(names) > 1 and names[0] != names[1] else ""


def warn_of_color_focal(capture: Capture, ratio: float) -> Notice:
    """Warns that the color camera's focal length is ``ratio`` times what the capture states."""
    return Notice(
        "color-focal-corrected",
        f"Color and depth of {capture.path} match only if the color camera's focal length is {ratio:.3f} of what its "
        "files state, so color is resampled with this focal length (capture.color_focal=1 turns this off).",
    )


def warn_of_registration(capture: Capture) -> Notice:
    """Warns that no focal length of the color camera makes color and depth match."""
    return Notice(
        "registration-doubtful",
        f"Color and depth of {capture.path} do not seem to lie on each other: matched features fit depth better and "
        "better up to the largest change of the focal length that is tried, a quarter. Record depth aligned to color, "
        "or give the intrinsics of both cameras.",
    )


def warn_of_scale() -> Notice:
    """Warns that lengths are not in meters."""
    return Notice(
        "scale-unknown",
        "The scale of this map is unknown: its lengths, also its voxel size, are in a unit in which the scene "
        "is about 2 deep. Give meters per unit with --scale, or scale the map by a known length: freeocc3d scale.",
    )


def warn_of_trajectory(trajectory: Trajectory, why_lost: str = "") -> Iterator[Notice]:
    """Warns that the map shows only part of the scan: frames are unreadable, lost, or in other submaps. why_lost: what
    was measured in lost frames, a sentence."""
    used = max(int(np.count_nonzero(trajectory.status != "unused")), 1)
    if broken := int(np.count_nonzero(trajectory.status == "broken")):
        text = (
            f"{_frames(broken)} could not be read and {'were' if broken > 1 else 'was'} skipped; report.json says why."
        )
        yield Notice("broken-frames", text)
    if len(lost := np.flatnonzero(trajectory.status == "lost")):
        share = len(lost) / used
        text = (
            f"Tracking lost {_frames(len(lost))} ({share:.0%}), the first is frame {lost[0]}: what only these frames "
            "show is not in the map."
        )
        if share > _FEW_TRACKED:
            text += " Most of the scan is missing."
        yield Notice("frames-lost", f"{text} {why_lost}".strip())
    if len(apart := np.flatnonzero(trajectory.status == "apart")):
        yield Notice(
            "submaps-apart",
            f"{len(apart)} frames ({len(apart) / used:.0%}), the first is frame {apart[0]}, were tracked, but are not "
            "connected to the rest: they form submaps of their own. The map shows only the largest submap.",
        )


def _frames(count: int) -> str:
    return f"{count} frame{'s' if count > 1 else ''}"
