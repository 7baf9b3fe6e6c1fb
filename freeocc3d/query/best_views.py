"""Finds the keyframes that show a region best, and where in their images it is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

from ..core.transforms import invert, project, transform
from ..core.types import Occupancy, Trajectory

if TYPE_CHECKING:
    from ..storage.keyframes import Keyframes

MOST = 3
"""Most keyframes to return for a region."""


class VoxelSet(Protocol):
    """A region or an object."""

    @property
    def rows(self) -> NDArray[np.int64]:
        """(n,) rows of ``Occupancy.occupied_voxels()``."""


@dataclass(frozen=True)
class RegionView:
    """A keyframe that shows a region.

    frame: index of the keyframe's frame in the capture.  box: x0, y0, x1, y1, pixels of its image around the visible
    voxels, with the last pixels included.  visible: 0…1, share of the region's voxels that it shows.
    """

    frame: int
    box: tuple[int, int, int, int]
    visible: float


def best_views(
    occupancy: Occupancy, trajectory: Trajectory, keyframes: Keyframes, regions: Sequence[VoxelSet], most: int = MOST
) -> list[list[RegionView]]:
    """Returns, for each region, up to ``most`` keyframes that show a part of it. Keyframes that show more voxels come
    first, with counts rounded to a tenth of the best count; of equal ones, the larger box in its image comes first.

    A keyframe shows a voxel if the voxel's center falls on a pixel and the pixel's depth differs from the center's by
    no more than the voxel's edge. Raises MapError for a broken keyframe.
    """
    voxels, edges = occupancy.occupied_voxels(), occupancy.occupied_edges()
    centers = [occupancy.centers(voxels[region.rows], edges[region.rows]) for region in regions]
    sizes = [edges[region.rows] * occupancy.finest for region in regions]
    found: list[list[RegionView]] = [[] for _ in regions]
    cameras = [camera for _, camera in keyframes.views()]
    poses = zip(trajectory.keyframes, trajectory.T_world_keyframe, cameras, strict=True)
    for row, (frame, T, camera) in enumerate(poses):
        depth_m = None
        for region, points, size in zip(range(len(regions)), centers, sizes, strict=True):
            pixels, z = project(transform(invert(T), points), camera)
            with np.errstate(invalid="ignore"):
                at = np.rint(pixels)
                inside = ((at >= 0) & (at < (camera.width, camera.height))).all(axis=1)
            if not inside.any():
                continue
            depth_m = keyframes.depth_m(row) if depth_m is None else depth_m
            u, v = at[inside].astype(np.int64).T
            measured = depth_m[v, u]
            shown = (measured > 0) & (np.abs(measured - z[inside]) <= size[inside])
            if shown.any():
                half = 0.5 * np.stack((camera.fx, camera.fy)) * (size / z)[inside][shown, None]
                box = _box(pixels[inside][shown], half, camera.width, camera.height)
                found[region].append(RegionView(int(frame), box, float(shown.sum() / len(points))))
    return [_best(views)[:most] for views in found]


def _box(pixels: NDArray[np.float64], half: NDArray[np.float64], width: int, height: int) -> tuple[int, int, int, int]:
    """Returns the box of pixels around (P, 2) voxel centers, ``half`` (P, 2) pixels to each side, within the image."""
    x0, y0 = np.maximum(np.floor((pixels - half).min(axis=0) + 0.5), 0).astype(int).tolist()
    x1, y1 = np.minimum(np.floor((pixels + half).max(axis=0) + 0.5), (width - 1, height - 1)).astype(int).tolist()
    return x0, y0, x1, y1


def _best(views: list[RegionView]) -> list[RegionView]:
    """Returns the views, best first."""
    most = max((view.visible for view in views), default=1.0)

    def worth(view: RegionView) -> tuple[float, int]:
        x0, y0, x1, y1 = view.box
        return round(view.visible / most, 1), (x1 + 1 - x0) * (y1 + 1 - y0)

    return sorted(views, key=worth, reverse=True)
