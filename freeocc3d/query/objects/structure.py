"""Finds the surfaces that bound a room: floor, walls and ceiling.

A plane bounds the room if, over the whole height of the scan, nothing that lies behind it was seen to be free. The
front of a wardrobe does not: the air above it is free, in front of and behind its plane. Neither does a picture that
stands out from the wall, or the side of a bed.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...core.transforms import invert, transform
from ...core.types import BLOCK, FREE, Occupancy
from ...core.voxel_keys import contains, pack_voxels
from .surfels import Surfels

_LEAST_M2 = 0.25
"""Least area of a part of a wall or ceiling."""
_LARGE_M2 = 1.0
"""Area of a plane that is a wall even if hardly any place in front of it was seen to be free."""
_LEVEL, _UPRIGHT = 0.9, 0.3
"""Cosines between a normal and the vertical: at least that of a ceiling, at most that of a wall."""
_FACING = 0.8
"""Cosine between the normals of a surfel and of its plane."""
_FLOOR = 0.7
"""Cosine between the normal of a floor's surfel, rugs included, and up."""
_FRONT, _INSIDE = 1.5, 0.25
"""Voxels in front of a plane that must be free to say something, and behind it where free means that it is no wall: a
voxel of the wall itself must not count as in front of it, and thin walls have another room behind."""
_FREE_BEHIND = 0.05
"""Largest share of the places with free space in front that are free behind: noise of single voxels."""
_SEEN = 0.1
"""Least share of a plane's places that have free space in front, if the plane is not large."""
_STOREY_M, _BELOW_TOP_M = 2.2, 0.25
"""A plane that ends at most 0.25 m below the top of a scan that is as high as a storey (2.2 m is the least of building
codes) is a wall or built in, such as the lintel over an opening."""
_FEWEST = 3  # points of a plane
_TRIALS, _SAMPLE, _FITS = 32, 4000, 4


def find_structure(
    surfels: Surfels, parts: NDArray[np.int64], occupancy: Occupancy, T_gravity_map: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """Returns the (N,) surfels of walls and ceilings.

    parts: (N,) smooth parts of the surface, -1 for none; planes are looked for in each.
    T_gravity_map: (4, 4) to the frame of the surfels.
    """
    found = np.zeros(len(surfels), bool)
    space = _Space(occupancy, T_gravity_map)
    top = float(surfels.points[:, 2].max(initial=0))
    for rows, normal in _find_planes(surfels, parts):
        axes = _axes(normal)
        if axes is None:
            continue
        place = surfels.points @ axes.T
        low, high = np.percentile(place[rows, :2], (1, 99), axis=0)
        offset = float(np.median(place[rows, 2]))
        upright = axes[1, 2] > 0
        whole = (low, high) if not upright else ((low[0], space.size), (high[0], top))
        highest = float(np.percentile(surfels.points[rows, 2], 99))
        built_in = upright and top >= _STOREY_M and highest >= top - _BELOW_TOP_M
        if built_in or space.bounded_by(axes, np.array(whole), offset, len(rows) * surfels.spacing**2 >= _LARGE_M2):
            near = np.abs(place[:, 2] - offset) < 0.5 * space.size
            beside = (place[:, 0] > low[0] - 2 * space.size) & (place[:, 0] < high[0] + 2 * space.size)
            if not upright:
                beside &= (place[:, 1] > low[1] - 2 * space.size) & (place[:, 1] < high[1] + 2 * space.size)
            found |= near & beside & (surfels.normals @ axes[2] > _FACING)
            found[rows] = True
    return found


def find_floor(surfels: Surfels, within_m: float) -> NDArray[np.bool_]:
    """Returns the (N,) surfels of the floor, and of what lies flat on it: within some meters of z = 0, facing up."""
    return np.asarray((np.abs(surfels.points[:, 2]) < within_m) & (surfels.normals[:, 2] > _FLOOR))


def _axes(normal: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """(3, 3) rows: two directions along a wall or ceiling, of which a wall's second is up, and its normal made exactly
    level or vertical. None for other planes."""
    if normal[2] < -_LEVEL:
        return np.array(((1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, -1.0)))
    if abs(normal[2]) > _UPRIGHT:
        return None
    level = normal * (1, 1, 0) / np.hypot(*normal[:2])
    return np.stack((np.cross((0.0, 0.0, 1.0), level), np.array((0.0, 0.0, 1.0)), level))


def _find_planes(surfels: Surfels, parts: NDArray[np.int64]) -> list[tuple[NDArray[np.int64], NDArray[np.float64]]]:
    """Returns the surfels and normals of the planes in the parts, largest first.

    Source: M. Fischler, R. Bolles, Random Sample Consensus, CACM 1981; a surfel with its normal is a sample.
    """
    least = max(int(np.ceil(_LEAST_M2 / surfels.spacing**2)), _FEWEST)
    order = np.argsort(parts, kind="stable")
    starts = np.flatnonzero(np.diff(parts[order], prepend=-1))
    random = np.random.default_rng(0)
    planes = []
    for left in np.split(order, starts)[1:]:
        while len(left) >= least:
            tried = random.choice(left, min(_TRIALS, len(left)), replace=False)
            some = random.choice(left, min(_SAMPLE, len(left)), replace=False)
            counts = [len(_on_plane(surfels, some, surfels.normals[t], surfels.points[t])) for t in tried]
            at = tried[int(np.argmax(counts))]
            normal, through = surfels.normals[at], surfels.points[at]
            for _ in range(_FITS):
                rows = _on_plane(surfels, left, normal, through)
                if len(rows) < least:
                    break
                through = surfels.points[rows].mean(axis=0)
                across = np.linalg.eigh(np.cov(surfels.points[rows].T))[1][:, 0]
                normal = across * np.sign(across @ normal)
            rows = _on_plane(surfels, left, normal, through)
            if len(rows) < least:
                break
            planes.append((rows, normal))
            left = np.setdiff1d(left, rows)
    return sorted(planes, key=lambda plane: -len(plane[0]))


def _on_plane(
    surfels: Surfels, rows: NDArray[np.int64], normal: NDArray[np.float64], through: NDArray[np.float64]
) -> NDArray[np.int64]:
    near = np.abs((surfels.points[rows] - through) @ normal) < surfels.spacing
    return rows[near & (surfels.normals[rows] @ normal > _FACING)]


class _Space:
    """The free space of a map, in the frame of the surfels."""

    def __init__(self, occupancy: Occupancy, T_gravity_map: NDArray[np.float64]):
        self.occupancy = occupancy
        self.size = occupancy.voxel_size
        self.T_map_gravity = invert(T_gravity_map)

    def bounded_by(self, axes: NDArray[np.float64], corners: NDArray[np.float64], offset: float, large: bool) -> bool:
        """Whether the space ends at a rectangle. corners: (2, 2) lowest and highest place along the first two axes."""
        first, second = (np.arange(low + 0.5 * self.size, high, self.size) for low, high in corners.T)
        if not len(first) or not len(second):
            return False
        along = np.stack(np.meshgrid(first, second, indexing="ij"), axis=-1).reshape(-1, 2) @ axes[:2]
        front, inside = (
            self._is_free(along + (offset + voxels * self.size) * axes[2]) for voxels in (_FRONT, -_INSIDE)
        )
        seen = np.count_nonzero(front)
        return bool((large or seen >= _SEEN * len(along)) and (front & inside).sum() <= _FREE_BEHIND * seen)

    def _is_free(self, points: NDArray[np.float64]) -> NDArray[np.bool_]:
        """(P,) whether each point lies in a free voxel."""
        at = (transform(self.T_map_gravity, points) - self.occupancy.origin) / self.occupancy.voxel_size
        free = np.zeros(len(points), bool)
        for level in np.unique(self.occupancy.levels):
            blocks = np.flatnonzero(self.occupancy.levels == level)
            packed = pack_voxels(self.occupancy.keys[blocks])
            order = np.argsort(packed)
            voxel = np.floor(at * 2.0**level).astype(np.int64)
            wanted = pack_voxels(voxel // BLOCK)
            held = contains(packed[order], wanted)
            block = blocks[order[np.searchsorted(packed[order], wanted[held])]]
            free[held] = self.occupancy.state[block, voxel[held] % BLOCK @ (64, 8, 1)] == FREE
        return free
