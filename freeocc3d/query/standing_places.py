"""Finds places where a robot can stand on the floor and see a region."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import KDTree

from ..core.errors import MapError
from ..core.sampling import spread_evenly
from ..core.transforms import invert, transform
from ..core.types import FREE, OCCUPIED, UNKNOWN, Occupancy
from ..occupancy.resampling import resample_occupancy
from .regions import Region

_MOST_CELLS = 1 << 29
_DRIVEN_OVER = 0.1  # meters above the floor: nothing lower is an obstacle
_MIN_FREE = 0.5  # least share of a column's voxels that images saw through
_HALF_DIAGONAL = 0.5**0.5  # cells: greatest distance from an obstacle cell's center to its parts
_SAMPLES = 16  # number of a region's voxels to test
_SEEN = 0.25  # least share of these that the robot must see
_AT_ONCE = 256  # number of places to test together


@dataclass(frozen=True)
class Robot:
    """An upright cylinder that looks from the middle of its top.

    radius, height: meters.
    """

    radius: float = 0.3
    height: float = 1.5


def standing_places(
    occupancy: Occupancy, T_gravity_map: NDArray[np.float64], regions: Sequence[Region], robot: Robot | None = None
) -> list[NDArray[np.float64] | None]:
    """Returns, for each region, the (3,) nearest place on the floor, map frame, where the robot has room and sees a
    quarter of the region or more. Nearest means to the region's voxels, as seen from above. None if there is no place.

    T_gravity_map: (4, 4) rigid, to the frame with z up and the floor at z = 0. The robot has room if, within its
    radius, no voxel is occupied from 10 cm above the floor up to its height, half of these voxels or more are known to
    be free, and the floor is known in the middle. The robot sees a voxel if no occupied voxel outside of the region
    lies between the voxel's center and the robot's top. Raises MapError for a map that is too large.
    """
    robot = robot or Robot()
    plain = occupancy.replace(features=np.zeros((len(occupancy.colors), 0), np.float16))
    one = plain
    if occupancy.deepest:
        from ..occupancy.levels import make_uniform

        one = make_uniform(plain)
    level, rows = one, np.arange(len(one.colors))
    if not np.array_equal(T_gravity_map, np.eye(4)):
        level, rows = resample_occupancy(one, T_gravity_map, np.array((0.0, 0.0, -0.5 * one.voxel_size)))
    if not len(level.voxels(OCCUPIED)):
        return [None] * len(regions)
    cells = _Cells(level)
    places = cells.with_room(robot)
    centers = occupancy.centers(occupancy.occupied_voxels(), occupancy.occupied_edges())
    centers = transform(T_gravity_map, centers)
    if occupancy.deepest:
        rows = KDTree(centers).query(level.centers(level.occupied_voxels()))[1]
    T_map_gravity = invert(T_gravity_map)
    found: list[NDArray[np.float64] | None] = []
    for region in regions:
        own = level.occupied_voxels()[np.isin(rows, region.rows)]
        place = cells.nearest(places, centers[region.rows], own, robot.height)
        found.append(None if place is None else np.asarray(transform(T_map_gravity, np.array((*place, 0.0)))))
    return found


class _Cells:
    """The states of all voxels in the known box of a level map."""

    def __init__(self, level: Occupancy):
        self.size = level.voxel_size
        voxels = {state: level.voxels(state) for state in (FREE, OCCUPIED)}
        known = np.concatenate(list(voxels.values()))
        self.corner = known.min(axis=0).astype(np.int64)
        shape = known.max(axis=0) - self.corner + 1
        if shape.prod() > _MOST_CELLS:
            raise MapError(
                f"A map of {shape.prod():.3g} voxels is too large for standing places: reconstruct it with larger "
                "voxels."
            )
        self.origin = level.origin + self.corner * self.size
        self.state = np.full(shape, UNKNOWN, np.uint8)
        for state, at in voxels.items():
            self.state[tuple((at - self.corner).T)] = state

    def with_room(self, robot: Robot) -> NDArray[np.float64]:
        """Returns the (P, 2) places x, y where the robot has room to stand."""
        heights = self.origin[2] + (np.arange(self.state.shape[2]) + 0.5) * self.size
        body = self.state[:, :, (heights >= _DRIVEN_OVER) & (heights <= robot.height)]
        layers = max(1, int((robot.height - _DRIVEN_OVER) / self.size))
        room = ~(body == OCCUPIED).any(axis=2) & ((body == FREE).sum(axis=2) >= _MIN_FREE * layers)
        to_obstacle = ndimage.distance_transform_edt(np.pad(room, 1))[1:-1, 1:-1]  # between the cells' centers
        floor = (self.state[:, :, np.abs(heights) < 1.25 * self.size] == OCCUPIED).any(axis=2)
        cells = np.argwhere(floor & ((to_obstacle - _HALF_DIAGONAL) * self.size >= robot.radius))
        return np.asarray(self.origin[:2] + (cells + 0.5) * self.size)

    def nearest(
        self, places: NDArray[np.float64], targets: NDArray[np.float64], own: NDArray[np.int32], eye: float
    ) -> NDArray[np.float64] | None:
        """Returns the (2,) place that sees the targets and is nearest to them. targets: (N, 3) centers of a region."""
        distance = KDTree(targets[:, :2]).query(places)[0] if len(places) else np.zeros(0)
        order = np.argsort(distance, kind="stable")
        some = targets[spread_evenly(len(targets), _SAMPLES)]
        blocks = self.state == OCCUPIED
        blocks[tuple((own - self.corner).T)] = False
        for start in range(0, len(order), _AT_ONCE):
            tried = places[order[start : start + _AT_ONCE]]
            eyes = np.concatenate((tried, np.full((len(tried), 1), eye)), axis=1)
            sees = self._open(blocks, eyes, some).mean(axis=1) >= _SEEN
            if sees.any():
                return np.asarray(tried[int(np.argmax(sees))])
        return None

    def _open(
        self, blocks: NDArray[np.bool_], eyes: NDArray[np.float64], targets: NDArray[np.float64]
    ) -> NDArray[np.bool_]:
        """Returns (E, N) whether the line from each of (E, 3) eyes to each of (N, 3) targets is free, at steps of half
        a voxel."""
        way = targets - eyes[:, None]
        steps = max(1, int(np.ceil(np.linalg.norm(way, axis=-1).max() / (0.5 * self.size))))
        blocked = np.zeros(way.shape[:2], bool)
        for share in np.arange(steps) / steps:  # tests the eye's own cell too; it may be above the map
            at = np.floor((eyes[:, None] + share * way - self.origin) / self.size).astype(np.int64)
            inside = ((at >= 0) & (at < blocks.shape)).all(axis=-1)
            blocked[inside] |= blocks[tuple(at[inside].T)]
        return ~blocked
