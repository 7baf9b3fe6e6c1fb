"""Free and unknown space: counts the depth images that see through each voxel and those that end in it."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numba import prange
from numpy.typing import NDArray

from ..core.compiling import njit
from ..core.depth_noise import look_up_sigma, take_sigma
from ..core.transforms import back_project, invert, transform
from ..core.types import BLOCK, Frame
from ..core.voxel_keys import unpack_voxels
from ..settings.stages import CarvingOptions as Options
from .voxel_blocks import find_blocks_along_rays, refuse_blocks

_SIGMAS = 3
"""Standard deviations of a depth within which its surface lies: 99.7 % of Gaussian noise."""
_NEAREST_M = 1e-3
"""Meters; avoids division by 0 for an image without depth."""
_NARROW = 64
"""Divides the image's width. A pixel without any depth within this part of the width lies in a wide empty patch, not in
a small hole along the edge of a thing."""


def compute_log_odds(free: NDArray[np.uint16], hits: NDArray[np.uint16], options: Options) -> NDArray[np.float32]:
    """Returns the log-odds of occupancy from depth images alone. free, hits: how many saw through and ended in a voxel.

    The inverse sensor model adds ``hit`` near the measured depth: within half a voxel plus the depth's uncertainty,
    which grows with the square of the depth. It adds ``-miss`` in front of that, past a margin, and nothing behind.
    Source: A. Hornung et al., OctoMap, Autonomous Robots 34(3), 2013, eq. 2.
    """
    return np.float32(options.hit) * hits - np.float32(options.miss) * free


class DepthEvidence:
    """Counts, for every voxel, the depth images that saw through it and those that ended in it.

    The test looks up five points in the depth image: a voxel's center and the four points half a voxel away from it
    along the image's axes. The image sees through the voxel only if none of the five shows anything in front of the
    voxel's back. So a chair leg that fills a quarter of a voxel keeps the voxel from being free.

    A frame counts in the blocks that the rays of its pixels pass through, whatever other frames do. So the counts do
    not depend on the order of frames, and a frame can be removed again. A voxel of a visited block takes 4 bytes.

    within: ascending packed keys of the only blocks to count in; all by default.
    """

    def __init__(
        self,
        origin: NDArray[np.float64],
        voxel_size: float,
        options: Options,
        within: NDArray[np.int64] | None = None,
    ):
        self.origin = np.asarray(origin, np.float64)
        self.voxel_size = voxel_size
        self.options = options
        self.within = within
        self.packed = np.zeros(0, np.int64)
        """(B,) ascending packed keys of the blocks that some frame looked into."""
        self._row = np.zeros(0, np.int64)  # each block's row in the counts, which have spare rows
        self._free = np.zeros((0, BLOCK**3), np.uint16)
        self._hits = np.zeros((0, BLOCK**3), np.uint16)

    @property
    def free(self) -> NDArray[np.uint16]:
        """(B, 512) depth images that saw through each voxel."""
        return self._free[self._row]

    @property
    def hits(self) -> NDArray[np.uint16]:
        """(B, 512) depth images that ended in each voxel."""
        return self._hits[self._row]

    def add(self, frame: Frame, T_world_cam: NDArray[np.float64]) -> NDArray[np.int64]:
        """Counts one depth image. Returns the packed keys of the blocks that it looks into."""
        frame = self._mark_empty(frame)
        packed = self.visible_blocks(frame, T_world_cam)
        self._make_room(np.setdiff1d(packed, self.packed, assume_unique=True))
        self._count(packed, frame, T_world_cam, 1)
        return packed

    def remove(self, frame: Frame, T_world_cam: NDArray[np.float64]) -> NDArray[np.int64]:
        """Takes back a depth image that was added at this pose. Returns the packed keys of the blocks that it looked
        into. These blocks stay; their counts may be zero."""
        frame = self._mark_empty(frame)
        packed = self.visible_blocks(frame, T_world_cam)
        self._count(packed, frame, T_world_cam, -1)
        return packed

    def visible_blocks(self, frame: Frame, T_world_cam: NDArray[np.float64]) -> NDArray[np.int64]:
        """Returns the ascending packed keys of the blocks from the camera to just behind the measured depth, or those
        of ``within``. At the greatest depth, rays are no farther apart than half a block."""
        if self.within is not None:
            return self.within
        camera = frame.intrinsics
        reach = np.abs(frame.depth_m)
        farthest = max(float(reach.max(initial=0.0)), _NEAREST_M)
        step = max(1, min(self.options.ray_step, int(0.5 * BLOCK * self.voxel_size * camera.fx / farthest)))
        rows, columns = (np.union1d(np.arange(0, n, step), n - 1) for n in frame.depth_m.shape)
        measured = reach[np.ix_(rows, columns)]
        v, u = np.nonzero(measured)
        pixels = np.stack((columns[u], rows[v]), axis=1)
        if frame.depth_sigma_m is not None:
            sigma = frame.depth_sigma_m[rows[v], columns[u]]
        else:
            sigma = frame.sensor.compute_sigma(measured[v, u])
        z = measured[v, u] + 0.5 * self.voxel_size + _SIGMAS * sigma
        points = transform(T_world_cam, back_project(pixels, z.astype(np.float32), camera).astype(np.float64))
        return find_blocks_along_rays(points, T_world_cam[:3, 3], self.origin, self.voxel_size)

    def _mark_empty(self, frame: Frame) -> Frame:
        """Returns the frame with depth ``-no_return`` for pixels in a wide empty patch: space is free up to there."""
        if not self.options.no_return:
            return frame
        from scipy import ndimage

        wide = 2 * (frame.depth_m.shape[1] // _NARROW) + 1
        nothing = ndimage.maximum_filter(frame.depth_m, wide, mode="nearest") == 0
        depth = np.where(nothing, np.float32(-self.options.no_return), frame.depth_m)
        return replace(frame, depth_m=depth)

    def at(self, packed: NDArray[np.int64]) -> tuple[NDArray[np.uint16], NDArray[np.uint16]]:
        """Returns the (B, 512) counts free and hits of some blocks; zeros where no frame looked."""
        free, hits = (np.zeros((len(packed), BLOCK**3), np.uint16) for _ in range(2))
        known = np.isin(packed, self.packed)
        rows = self._row[np.searchsorted(self.packed, packed[known])]
        free[known], hits[known] = self._free[rows], self._hits[rows]
        return free, hits

    def _make_room(self, new: NDArray[np.int64]) -> None:
        if not len(new):
            return
        used, wanted = len(self.packed), len(self.packed) + len(new)
        if wanted > len(self._free):
            refuse_blocks(wanted, self.voxel_size)
            more = np.zeros((max(wanted, 3 * len(self._free) // 2) - len(self._free), BLOCK**3), np.uint16)
            self._free, self._hits = np.concatenate((self._free, more)), np.concatenate((self._hits, more))
        place = np.searchsorted(self.packed, new)
        self.packed = np.insert(self.packed, place, new)
        self._row = np.insert(self._row, place, np.arange(used, wanted))

    def _count(self, packed: NDArray[np.int64], frame: Frame, T_world_cam: NDArray[np.float64], change: int) -> None:
        camera = frame.intrinsics
        T_cam_world = invert(T_world_cam)
        _count(
            unpack_voxels(packed),
            self._row[np.searchsorted(self.packed, packed)],
            (T_cam_world[:3, :3] * self.voxel_size).astype(np.float32),
            (T_cam_world[:3, :3] @ self.origin + T_cam_world[:3, 3]).astype(np.float32),
            np.array((camera.fx, camera.fy, camera.cx, camera.cy), np.float32),
            frame.depth_m,
            take_sigma(frame),
            np.float32(self.voxel_size),
            np.float32(self.options.margin * self.voxel_size),
            np.uint16(change % (1 << 16)),  # adding 65535 subtracts one
            self._free,
            self._hits,
        )


@njit(parallel=True, cache=True)
def _count(
    keys: NDArray[np.int32],
    rows: NDArray[np.int64],
    R: NDArray[np.float32],  # from voxels to meters in the camera's frame
    t: NDArray[np.float32],
    camera: NDArray[np.float32],
    depth_m: NDArray[np.float32],
    sigma_m: NDArray[np.float32],
    voxel_size: np.float32,
    margin: np.float32,
    change: np.uint16,
    free: NDArray[np.uint16],
    hits: NDArray[np.uint16],
) -> None:
    fx, fy, cx, cy = camera[0], camera[1], camera[2], camera[3]
    height, width = depth_m.shape
    half = np.float32(0.5) * voxel_size
    for b in prange(len(keys)):
        row_of_block = rows[b]
        x0, y0, z0 = keys[b, 0] * BLOCK, keys[b, 1] * BLOCK, keys[b, 2] * BLOCK
        for voxel in range(BLOCK**3):
            vx = x0 + voxel // BLOCK**2 + np.float32(0.5)
            vy = y0 + voxel // BLOCK % BLOCK + np.float32(0.5)
            vz = z0 + voxel % BLOCK + np.float32(0.5)
            z = R[2, 0] * vx + R[2, 1] * vy + R[2, 2] * vz + t[2]
            if z < half:
                continue
            u = fx * (R[0, 0] * vx + R[0, 1] * vy + R[0, 2] * vz + t[0]) / z + cx
            v = fy * (R[1, 0] * vx + R[1, 1] * vy + R[1, 2] * vz + t[1]) / z + cy
            if not (u + 0.5 >= 0 and v + 0.5 >= 0 and u + 0.5 < width and v + 0.5 < height):
                continue
            column, row = math.floor(u + 0.5), math.floor(v + 0.5)
            depth = depth_m[row, column]
            if depth == 0:
                continue
            spread = np.float32(_SIGMAS * look_up_sigma(sigma_m, row, column, abs(depth)))
            far = margin + spread
            if abs(depth) - z > far:
                du, dv = int(fx * half / z), int(fy * half / z)
                if (
                    _beyond(depth_m, row, column - du, z + far)
                    and _beyond(depth_m, row, column + du, z + far)
                    and _beyond(depth_m, row - dv, column, z + far)
                    and _beyond(depth_m, row + dv, column, z + far)
                ):
                    free[row_of_block, voxel] += change
            elif depth > 0 and abs(depth - z) <= half + spread:
                hits[row_of_block, voxel] += change


@njit(cache=True)
def _beyond(depth_m: NDArray[np.float32], row: int, column: int, z: np.float32) -> bool:
    """Whether a pixel has no measured depth in front of z. A pixel outside of the image has none."""
    if row < 0 or column < 0 or row >= depth_m.shape[0] or column >= depth_m.shape[1]:
        return True
    depth = depth_m[row, column]
    return depth <= 0 or depth > z
