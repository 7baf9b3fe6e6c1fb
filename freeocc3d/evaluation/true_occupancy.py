"""The truth about a scene: a labeled voxel grid with the observed voxels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..core.types import UNKNOWN


@dataclass(frozen=True)
class GroundTruth:
    """True occupancy of a scene, ``ground_truth.npz``.

    labels: (X, Y, Z) uint8, 0 free, k = ``classes[k]``, 255 not observed.
    origin: (3,) float64 lower corner of voxel (0, 0, 0) in the frame of the true poses, meters.
    voxel_size: edge of a voxel, meters.  classes: names of the labels; ``classes[0]`` is not used.
    frames_mask: (X, Y, Z) bool, the union of the frames' own masks, if the data set has such masks.
    """

    labels: NDArray[np.uint8]
    origin: NDArray[np.float64]
    voxel_size: float
    classes: tuple[str, ...]
    frames_mask: NDArray[np.bool_] | None = None

    @property
    def shape(self) -> tuple[int, int, int]:
        """Voxels along x, y and z."""
        x, y, z = self.labels.shape
        return x, y, z

    def centers(self) -> NDArray[np.float64]:
        """Returns the (X, Y, Z, 3) voxel centers in the frame of the true poses, meters."""
        return self.origin + (np.moveaxis(np.indices(self.shape), 0, -1) + 0.5) * self.voxel_size

    def masks(self) -> dict[str, NDArray[np.bool_]]:
        """Returns the masks for scoring, (X, Y, Z) bool each: "label", the voxels with known truth (label != 255), and,
        if the data set has masks of its frames, "frames", the known voxels of their union.

        EmbodiedOcc scores with "frames", FreeOcc's release with "label".
        """
        known = self.labels != UNKNOWN
        return {"label": known} | ({} if self.frames_mask is None else {"frames": known & self.frames_mask})
