"""Says in one sentence why a scan gives no poses, and what would help, from what its images have in common."""

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
    """Raises TrackingError for a scan of too few images."""
    if count < LEAST_IMAGES:
        raise TrackingError(
            f"{what} has {count} usable image{'s' if count != 1 else ''}, and poses by structure from motion need at "
            f"least {LEAST_IMAGES}, better 50: film longer, or use a smaller capture.stride."
        )


def check_features(counts: list[int], what: str) -> None:
    """Raises TrackingError if most images show nothing that could be recognized."""
    if np.median(counts) < _FEW_FEATURES:
        raise TrackingError(
            f"The images of {what} are blurred or show bare surfaces: half of them have at most "
            f"{int(np.median(counts))} features. Film sharp images of textured things: {_SLOWLY}."
        )


def check_motion(database: SfmDatabase, what: str) -> None:
    """Raises TrackingError if images have too little in common, or the camera did not move."""
    pairs = [(a, b) for a, b, _, inliers in database.geometries() if inliers]
    if len(pairs) < _LEAST_PAIRS:
        raise TrackingError(
            f"The images of {what} show too little of the same: {len(pairs)} pairs of {len(database.frames())} images "
            f"could be matched. {_SLOWLY.capitalize()}."
        )
    step = max(len(pairs) // _MOST_SAMPLED, 1)
    moved = [database.displacement(*pair) for pair in pairs[::step]]
    if max(moved) < _STILL_PX * max(database.size()[0] / 640, 1):
        raise TrackingError(
            f"The camera of {what} stands still: between its images things move by {max(moved):.1f} pixels at "
            "most. Walk around what is to be mapped."
        )


def explain_missing_model(database: SfmDatabase, registered: int, what: str) -> TrackingError:
    """The error for a scan whose images match, but of which no model or one of only ``registered`` images came."""
    pairs = [(kind, inliers) for *_, kind, inliers in database.geometries() if inliers]
    flat = np.mean([kind in ("PLANAR_OR_PANORAMIC", "PLANAR", "PANORAMIC") for kind, _ in pairs])
    if flat > 0.5:
        return TrackingError(
            f"The camera of {what} seems only to turn, or to see one flat wall: {flat:.0%} of its pairs of images tell "
            "no depth. Walk sideways while filming, so that near things move against far ones."
        )
    return TrackingError(
        f"Of the {len(database.frames())} images of {what} only {registered} could be placed, which is no map: "
        f"{_SLOWLY}."
    )
