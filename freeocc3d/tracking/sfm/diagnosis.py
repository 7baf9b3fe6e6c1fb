"""Explains why a scan gives no poses, and what would help, from the matches of its images."""

from __future__ import annotations

import numpy as np

from ...core.errors import TrackingError
from .database import SfmDatabase

LEAST_IMAGES = 5
_FEW_FEATURES = 40
_STILL_PX = 1.0
_LEAST_PAIRS = 3
_MOST_SAMPLED = 100
_SLOWLY = "film slowly, in good light, with half of each image seen in the next"


def check_count(count: int, what: str) -> None:
    """Raise TrackingError for a scan of too few images."""
    if count < LEAST_IMAGES:
        raise TrackingError(
            f"{what} has {count} usable image{'s' if count != 1 else ''}, but structure from motion needs at least "
            f"{LEAST_IMAGES}, better 50: film longer, or use a smaller capture.stride."
        )


def check_features(counts: list[int], what: str) -> None:
    """Raise TrackingError if most images have too few features."""
    if np.median(counts) < _FEW_FEATURES:
        raise TrackingError(
            f"The images of {what} are blurred or show bare surfaces: half of them have no more than "
            f"{int(np.median(counts))} features. Film sharp images of textured objects: {_SLOWLY}."
        )


def check_motion(database: SfmDatabase, what: str) -> None:
    """Raise TrackingError if images overlap too little, or the camera does not move."""
    pairs = [(a, b) for a, b, _, inliers in database.geometries() if inliers]
    if len(pairs) < _LEAST_PAIRS:
        raise TrackingError(
            f"The images of {what} overlap too little: only {len(pairs)} pairs of {len(database.frames())} images "
            f"match. {_SLOWLY.capitalize()}."
        )
    step = max(len(pairs) // _MOST_SAMPLED, 1)
    moved = [database.displacement(*pair) for pair in pairs[::step]]
    if max(moved) < _STILL_PX * max(database.size()[0] / 640, 1):
        raise TrackingError(
            f"The camera of {what} stands still: its images move by no more than {max(moved):.1f} pixels. "
            "Walk around the scene."
        )


def explain_missing_model(database: SfmDatabase, registered: int, what: str) -> TrackingError:
    """The error for a scan with matching images but no model, or a model of only ``registered`` images."""
    pairs = [(kind, inliers) for *_, kind, inliers in database.geometries() if inliers]
    flat = np.mean([kind in ("PLANAR_OR_PANORAMIC", "PLANAR", "PANORAMIC") for kind, _ in pairs])
    if flat > 0.5:
        return TrackingError(
            f"The camera of {what} seems only to turn, or to see one flat wall: {flat:.0%} of its image pairs give no "
            "depth. Walk sideways while filming, so that near objects move against far ones."
        )
    middle = np.median([inliers for _, inliers in pairs] or [0])
    return TrackingError(
        f"Of the {len(database.frames())} images of {what}, only {registered} got a pose, too few for a map: "
        f"{len(pairs)} pairs of images match, half of these with no more than {middle:.0f} points. "
        f"{_SLOWLY.capitalize()}."
    )
