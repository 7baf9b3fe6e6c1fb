"""Brings the color and the depth images of one rig to one pixel grid.

There are three cases:
1. Same camera: nothing changes.
2. Same viewpoint, but other size or intrinsics: color is resampled to the depth camera's pixels, with area averages
   where it shrinks. Depth stays, except that pixels outside the color image become 0.
3. Different viewpoints: color is resized to the smaller of the two sizes. Each depth pixel moves there as a patch that
   covers the area of the pixel; the nearest patch wins.
Depth is never interpolated: every output value is a measured one, possibly from another viewpoint.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from ...core.transforms import back_project
from ...core.types import Intrinsics

SAME_PX = 0.25
"""Two cameras are the same if their pixels differ by less than this everywhere."""

SAME_M = 1e-4
"""Extrinsics are the identity if all entries differ from it by less than this (meters, radians)."""

OVERLAP_PX = 0.25
"""Each patch grows by this much on each side, so that slanted surfaces have no cracks between patches."""


class PixelGrid:
    """The common pixel grid of a color and a depth camera.

    color, depth: the two cameras.  T_color_depth: (4, 4) depth to color camera frame; None if they coincide.
    """

    intrinsics: Intrinsics
    """The camera of the output images."""

    def __init__(self, color: Intrinsics, depth: Intrinsics, T_color_depth: NDArray[np.float64] | None = None):
        self._patches: DepthPatches | None = None
        if T_color_depth is not None and np.abs(T_color_depth - np.eye(4)).max() > SAME_M:
            smaller = min(color, depth, key=lambda camera: camera.width * camera.height)
            self.intrinsics = color.resized(smaller.width, smaller.height)
            self._patches = DepthPatches(depth, self.intrinsics, T_color_depth)
        else:
            self.intrinsics = depth
        resized_color = color.resized(self.intrinsics.width, self.intrinsics.height)
        self._color_from_grid = _pixel_map(self.intrinsics, resized_color)
        self._reach = None if self._color_from_grid is None else _reached(self._color_from_grid, self.intrinsics)

    def color(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Resample a color image (H, W, 3) to the grid (h, w, 3)."""
        shrinks = image.shape[0] >= self.intrinsics.height and image.shape[1] >= self.intrinsics.width
        return self._resample(image, cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR, cv2.INTER_LINEAR)

    def classes(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Resample a class image (H, W) of the color camera to the grid (h, w), by the nearest pixel."""
        return self._resample(image, cv2.INTER_NEAREST_EXACT, cv2.INTER_NEAREST)

    def depth(self, depth_m: NDArray[np.float32]) -> NDArray[np.float32]:
        """Bring depth (H, W), meters, to the grid (h, w), meters. May change its argument."""
        if self._patches is not None:
            return self._patches.move(depth_m)
        if self._reach is not None:
            rows, columns = self._reach
            depth_m[: rows.start] = depth_m[rows.stop :] = 0.0
            depth_m[:, : columns.start] = depth_m[:, columns.stop :] = 0.0
        return depth_m

    def _resample(self, image: NDArray[np.uint8], resize_by: int, shift_by: int) -> NDArray[np.uint8]:
        size = self.intrinsics.width, self.intrinsics.height
        if image.shape[1::-1] != size:
            image = cv2.resize(image, size, interpolation=resize_by)
        if self._color_from_grid is not None:
            flags = shift_by | cv2.WARP_INVERSE_MAP
            image = cv2.warpAffine(image, self._color_from_grid, size, flags=flags, borderMode=cv2.BORDER_REPLICATE)
        return image


class DepthPatches:
    """Warps depth images forward into another camera, with a z-buffer.

    A depth pixel is a square patch that faces the camera. Its size in the target is the pixel size times the ratio of
    the focal lengths: the cameras of a rig are centimeters apart, so the ratio of their depths is near 1.
    """

    def __init__(self, depth: Intrinsics, target: Intrinsics, T_target_depth: NDArray[np.float64]):
        self._target = target
        self._half = 0.5 * target.fx / depth.fx + OVERLAP_PX, 0.5 * target.fy / depth.fy + OVERLAP_PX
        v, u = np.mgrid[: depth.height, : depth.width]
        rays = back_project(np.stack((u, v), axis=-1), np.ones(u.shape), depth).reshape(-1, 3)
        self._rays = np.ascontiguousarray((rays @ T_target_depth[:3, :3].T).T.astype(np.float32))
        self._offset = T_target_depth[:3, 3].astype(np.float32)

    def move(self, depth_m: NDArray[np.float32]) -> NDArray[np.float32]:
        """Warp depth (H, W), meters, to (h, w), meters, in the target camera; 0 where no patch lands."""
        width, height = self._target.width, self._target.height
        flat = depth_m.reshape(-1)
        measured = np.flatnonzero(flat)
        x, y, z = self._rays[:, measured] * flat[measured] + self._offset[:, None]
        ahead = z > 0
        x, y, z = x[ahead], y[ahead], z[ahead]
        u, v = self._target.fx * x / z + self._target.cx, self._target.fy * y / z + self._target.cy
        nearest = np.full(height * width, np.inf, np.float32)
        for column, in_column in _covered(u, self._half[0], width):
            for row, in_row in _covered(v, self._half[1], height):
                inside = in_column & in_row
                np.minimum.at(nearest, row[inside] * width + column[inside], z[inside])
        nearest[np.isinf(nearest)] = 0.0
        return nearest.reshape(height, width)


def _covered(
    center: NDArray[np.float32], half: float, length: int
) -> list[tuple[NDArray[np.int64], NDArray[np.bool_]]]:
    """The pixels 0…length-1 with centers in ``center ± half``: a list of the first, second, … pixel for all centers at
    once, each with a mask of the pixels that exist."""
    first = np.ceil(np.clip(center - half, -1.0, length)).astype(np.int64)
    pixels = (first + step for step in range(int(2 * half) + 1))
    return [(pixel, (pixel >= 0) & (pixel < length) & (pixel <= center + half)) for pixel in pixels]


def _pixel_map(grid: Intrinsics, color: Intrinsics) -> NDArray[np.float64] | None:
    """(2, 3) map from grid pixels to pixels of a color image of the same size and viewpoint; None if they coincide."""
    ax, ay = color.fx / grid.fx, color.fy / grid.fy
    to_color = np.array([[ax, 0.0, color.cx - ax * grid.cx], [0.0, ay, color.cy - ay * grid.cy]])
    corners = np.array([[0.0, 0.0], [grid.width - 1.0, grid.height - 1.0]])
    moved = corners @ to_color[:, :2].T + to_color[:, 2]
    return to_color if np.abs(moved - corners).max() > SAME_PX else None


def _reached(color_from_grid: NDArray[np.float64], grid: Intrinsics) -> tuple[slice, slice]:
    """Rows and columns of the grid that lie inside the color image."""
    spans = []
    for axis, length in ((1, grid.height), (0, grid.width)):
        position = color_from_grid[axis, axis] * np.arange(length) + color_from_grid[axis, 2]
        inside = np.flatnonzero((position >= -0.5) & (position <= length - 0.5))
        spans.append(slice(int(inside[0]), int(inside[-1]) + 1) if len(inside) else slice(0, 0))
    return spans[0], spans[1]
