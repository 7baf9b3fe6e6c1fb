"""An object of a scene, and the options of finding objects. The module imports nothing heavy."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from ...core.types import Frame
from ...settings.option_types import PositiveInt
from ...settings.typed_options import TypedOptions

if TYPE_CHECKING:
    from ..best_views import RegionView
    from ..oriented_boxes import OrientedBox


Segment = Callable[[Frame], NDArray[np.integer]]
"""Gives the (H, W) number of the mask at each pixel of a frame, from 1; 0 = none."""


class Options(TypedOptions, frozen=True):
    """Which objects are found, and how they are described."""

    min_voxels: PositiveInt = 8
    """Least number of voxels of an object: a patch of surface of two by two voxels has no more."""
    names: PositiveInt = 5
    """Most names of an object."""
    views: PositiveInt = 3
    """Most keyframes of an object."""
    masks: str = ""
    """Folder of a model of kind "prompts" or "sam", or its name: masks of keyframes then divide the surface into
    things. Empty = class images or the surface alone do."""
    mask_keyframes: PositiveInt = 40
    """Most keyframes of which masks are made: the time is proportional."""
    mask_points: Annotated[int, Meta(ge=1, le=64)] = 16
    """Points along the longer side of a keyframe at which the model is asked for masks."""


@dataclass(frozen=True)
class Object:
    """A thing of the scene, such as one of several chairs. Map frame, z up, meters.

    rows: (n,) rows of ``Occupancy.occupied_voxels()``, ascending; no voxel belongs to two objects.
    feature: (D,) float32 unit feature of the map's encoder: the mean embedding of its best views where the encoder is
    installed and embeds pictures, else the mean of its voxels' features; zero where nothing is known.
    names: (name, probability) of the map's vocabulary, most probable first; the probabilities of all names of the
    vocabulary add to 1. Empty without a feature or a vocabulary.
    box: the upright box with the least level area.  volume_m3: of its voxels.  centroid: (3,) mean of their centers.
    keyframes: the keyframes that show it best, best first, with a pixel box in each.
    confidence: 0…1, ranks the objects: how much the voxels' features agree with the object's, times V / (V + 1 liter)
    for a volume V, as if one more liter disagreed.
    """

    rows: NDArray[np.int64]
    feature: NDArray[np.float32]
    names: tuple[tuple[str, float], ...]
    box: OrientedBox
    volume_m3: float
    centroid: NDArray[np.float64]
    keyframes: tuple[RegionView, ...]
    confidence: float

    @property
    def name(self) -> str:
        """The most probable name; "object" if there is none."""
        return self.names[0][0] if self.names else "object"
