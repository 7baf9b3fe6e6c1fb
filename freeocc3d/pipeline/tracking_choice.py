"""The choice of a tracker for a capture, where the configuration leaves it open."""

from __future__ import annotations

from ..capture import Capture
from ..settings.config import Settings

AUTO = "auto"

GIVEN = ("known", "file")
"""Trackers that take poses as they are."""


def choose_tracker(settings: Settings, capture: Capture) -> tuple[Settings, str]:
    """The settings with a tracker that can take the capture, and the reason for it, a sentence; an empty one if the
    settings name a tracker.

    Depth is tracked, whatever poses the capture states. Without depth, the poses of a reconstruction (nerfstudio,
    COLMAP) are used; without these, structure from motion estimates them.
    """
    if settings.tracking.backend != AUTO:
        return settings, ""
    if capture.has_depth:
        name, reason = "rgbd", "the capture has depth, so its poses are estimated from color and depth"
    elif capture.states_poses:
        name, reason = "known", "the capture has poses but no depth, so its poses are used and stereo gives the depth"
    else:
        name, reason = "colmap", "the capture has no depth, so structure from motion and stereo estimate all from color"
    frames = f"{len(capture)} frame{'s' if len(capture) != 1 else ''}"
    sentence = f"Tracking with {name}: {reason} (read as {capture.format}, {frames})."
    return settings.changed("tracking", backend=name), sentence
