"""Free and unknown: what each depth image saw through, where it ended, and what it says nothing about."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from ..errors import ConfigError
from ..geometry import back_project, invert, transform
from ..registry import require_positive
from ..types import BLOCK, Frame
from .grid import blocks_along_rays, unpack


@dataclass(frozen=True)
class Options:
    """Layer 4: free space from depth."""

    margin: float = 1.0
    """A voxel is seen through when the depth behind its centre is greater by this many voxel edges (and by the
    depth's uncertainty)."""
    noise: float = 0.0019
    """Growth of a depth's standard deviation with its square, 1/m; three of them are added to the margin."""
    min_free: int = 1
    """Depth images that must see through a voxel that holds no surface before it counts as free."""
    ray_step: int = 16
    """Every n-th pixel's ray (more where blocks are small) is followed to find the blocks that a camera looked into."""

    def __post_init__(self) -> None:
        require_positive(self, "margin", "min_free", "ray_step")
        if self.noise < 0:
            raise ConfigError(f"'noise' must not be negative, got {self.noise}.")


def visible_blocks(
    frame: Frame, T_world_cam: NDArray[np.float64], origin: NDArray[np.float64], voxel_size: float, ray_step: int
) -> NDArray[np.int64]:
    """Packed keys of the blocks between the camera and what its depth image shows. Rays are no farther apart than half
    a block at the greatest depth, so that few blocks are missed, and those at their corners."""
    farthest = max(float(frame.depth_m.max(initial=0.0)), 1e-3)
    ray_step = max(1, min(ray_step, int(0.5 * BLOCK * voxel_size * frame.intrinsics.fx / farthest)))
    depth = frame.depth_m[ray_step // 2 :: ray_step, ray_step // 2 :: ray_step]
    v, u = np.nonzero(depth)
    if len(v) == 0:
        return np.zeros(0, np.int64)
    pixels = np.stack((u, v), axis=1) * ray_step + ray_step // 2
    points = transform(T_world_cam, back_project(pixels, depth[v, u], frame.intrinsics).astype(np.float64))
    return blocks_along_rays(points, T_world_cam[:3, 3], origin, voxel_size)


class Evidence:
    """Counts, for every voxel of a set of blocks, the depth images that saw through it and those that ended in it.

    A voxel's centre and the four points half a voxel beside it (along the image's axes) are looked up in the depth
    image: it is seen through only if none of the five shows anything in front of its back, so that a chair's leg that
    fills a quarter of a voxel is not seen through beside the leg. 4 bytes a voxel.
    """

    def __init__(self, packed: NDArray[np.int64], origin: NDArray[np.float64], voxel_size: float, options: Options):
        self.keys = unpack(packed)
        self.origin = np.asarray(origin, np.float64)
        self.voxel_size = voxel_size
        self.options = options
        self.free = np.zeros((len(packed), BLOCK**3), np.uint16)
        self.hits = np.zeros((len(packed), BLOCK**3), np.uint16)

    def add(self, frame: Frame, T_world_cam: NDArray[np.float64]) -> None:
        """Count one depth image."""
        camera = frame.intrinsics
        T_cam_world = invert(T_world_cam)
        _count(
            self.keys,
            (T_cam_world[:3, :3] * self.voxel_size).astype(np.float32),
            (T_cam_world[:3, :3] @ self.origin + T_cam_world[:3, 3]).astype(np.float32),
            np.array((camera.fx, camera.fy, camera.cx, camera.cy), np.float32),
            frame.depth_m,
            np.float32(self.voxel_size),
            np.float32(self.options.margin * self.voxel_size),
            np.float32(3 * self.options.noise),
            self.free,
            self.hits,
        )


@njit(parallel=True, cache=True)
def _count(
    keys: NDArray[np.int32],
    R: NDArray[np.float32],  # voxels to metres in the camera's frame
    t: NDArray[np.float32],
    camera: NDArray[np.float32],
    depth_m: NDArray[np.float32],
    voxel_size: np.float32,
    margin: np.float32,
    noise: np.float32,
    free: NDArray[np.uint16],
    hits: NDArray[np.uint16],
) -> None:
    fx, fy, cx, cy = camera[0], camera[1], camera[2], camera[3]
    height, width = depth_m.shape
    half = np.float32(0.5) * voxel_size
    radius = half * np.float32(BLOCK * math.sqrt(3.0))
    for b in prange(len(keys)):
        x0, y0, z0 = keys[b, 0] * BLOCK, keys[b, 1] * BLOCK, keys[b, 2] * BLOCK
        middle = np.float32(0.5 * BLOCK)
        mx, my, mz = x0 + middle, y0 + middle, z0 + middle
        depth_of_block = R[2, 0] * mx + R[2, 1] * my + R[2, 2] * mz + t[2]
        if depth_of_block < -radius or not _sphere_in_view(
            R[0, 0] * mx + R[0, 1] * my + R[0, 2] * mz + t[0],
            R[1, 0] * mx + R[1, 1] * my + R[1, 2] * mz + t[1],
            depth_of_block, radius, camera, height, width,
        ):  # fmt: skip
            continue
        for voxel in range(BLOCK**3):
            vx = x0 + voxel // 64 + np.float32(0.5)
            vy = y0 + voxel // 8 % 8 + np.float32(0.5)
            vz = z0 + voxel % 8 + np.float32(0.5)
            z = R[2, 0] * vx + R[2, 1] * vy + R[2, 2] * vz + t[2]
            if z < half:
                continue
            u = fx * (R[0, 0] * vx + R[0, 1] * vy + R[0, 2] * vz + t[0]) / z + cx
            v = fy * (R[1, 0] * vx + R[1, 1] * vy + R[1, 2] * vz + t[1]) / z + cy
            column, row = math.floor(u + 0.5), math.floor(v + 0.5)
            if column < 0 or row < 0 or column >= width or row >= height:
                continue
            depth = depth_m[row, column]
            if depth <= 0:
                continue
            far = margin + noise * z * z
            if depth - z > far:
                du, dv = int(fx * half / z), int(fy * half / z)
                if (
                    _beyond(depth_m, row, column - du, z + far)
                    and _beyond(depth_m, row, column + du, z + far)
                    and _beyond(depth_m, row - dv, column, z + far)
                    and _beyond(depth_m, row + dv, column, z + far)
                ):
                    free[b, voxel] += np.uint16(1)
            elif abs(depth - z) <= half + noise * z * z:
                hits[b, voxel] += np.uint16(1)


@njit(cache=True)
def _beyond(depth_m: NDArray[np.float32], row: int, column: int, z: np.float32) -> bool:
    """Whether nothing in front of depth z is measured at a pixel (outside the image nothing is)."""
    if row < 0 or column < 0 or row >= depth_m.shape[0] or column >= depth_m.shape[1]:
        return True
    depth = depth_m[row, column]
    return depth <= 0 or depth > z


@njit(cache=True)
def _sphere_in_view(
    x: np.float32,
    y: np.float32,
    z: np.float32,
    radius: np.float32,
    camera: NDArray[np.float32],
    height: int,
    width: int,
) -> bool:
    """Whether a sphere at a camera-frame point may project into the image: false only if it certainly does not."""
    fx, fy, cx, cy = camera[0], camera[1], camera[2], camera[3]
    for f, c, size, along in ((fx, cx, width, x), (fy, cy, height, y)):
        low, high = -(c + np.float32(0.5)) / f, (size - c - np.float32(0.5)) / f
        if along - low * z < -radius * math.sqrt(1 + low * low):
            return False
        if along - high * z > radius * math.sqrt(1 + high * high):
            return False
    return True
