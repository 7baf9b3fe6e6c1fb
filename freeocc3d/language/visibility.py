"""Finds the Gaussians that an image shows, their pixels, and how well they are visible.

A Gaussian is visible where the depth map has a surface at its depth, |d_t(u) - z| <= tolerance. Where no depth was
measured (dark and shiny things, depth edges, beyond the sensor's range), the rendered depth of the Gaussians is used:
everything not behind the nearest of them is visible. A rendered depth never replaces a measured one, because it is as
thick as the Gaussians, and on slanted surfaces hides what lies on them.

The weight of a visible Gaussian is w = cos(theta) b / z^2: a near and frontal view has more pixels on the surface.
theta is the angle between the viewing ray and the normal of the depth map, and b <= 1 increases inward from the image's
edge, where encoders see things cut off.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import prange
from numpy.typing import NDArray

from ..core.compiling import njit
from ..core.transforms import invert, quats_to_rotations
from ..core.types import Frame, Gaussians
from ..settings.stages import LanguageOptions

_MIN_COSINE = np.float32(0.05)
"""Smallest cosine: for a view along the surface, and for one next to a depth edge, where pixels mix both sides."""
_EDGE = np.float32(0.25)
"""b at the edge of the image."""
_RENDERED_PIXELS = 4
"""Edge in pixels of the blocks of the rendered depth."""
_NEAR = np.float32(0.05)
"""Meters; nearer Gaussians are not rendered."""
_TINY_BORDER = 1e-6
"""Pixels; avoids division by a border of 0, for which b is 1 everywhere."""
_WIDEST = 16
"""Largest number of blocks, to each side, that one Gaussian covers."""


@dataclass(frozen=True)
class VisibleGaussians:
    """The M Gaussians that a frame shows.

    rows: (M,) int32, ascending.  pixels: (M,) int32, row * width + column of the pixel of each Gaussian.
    weights: (M,) float32, how well each is visible.  shape: (height, width) of the frame.
    """

    rows: NDArray[np.int32]
    pixels: NDArray[np.int32]
    weights: NDArray[np.float32]
    shape: tuple[int, int]

    def cells(self, shape: tuple[int, int]) -> NDArray[np.int32]:
        """(M,) row * w + column in features of (h, w) cells that cover the frame evenly."""
        (height, width), (h, w) = self.shape, shape
        row, column = np.divmod(self.pixels, np.int32(width))
        return np.asarray(row * h // height * w + column * w // width, np.int32)


def find_visible(
    gaussians: Gaussians, frame: Frame, T_world_cam: NDArray[np.float64], options: LanguageOptions
) -> VisibleGaussians:
    """Finds which of N Gaussians a frame shows."""
    camera, depth_m = frame.intrinsics, frame.depth_m
    pinhole = np.array((camera.fx, camera.fy, camera.cx, camera.cy), np.float32)
    T = invert(T_world_cam).astype(np.float32)
    rendered = _rendered(gaussians.means, gaussians.scales, T, pinhole, depth_m.shape)
    pixels, weights = np.empty(len(gaussians), np.int32), np.zeros(len(gaussians), np.float32)
    _see(
        gaussians.means, gaussians.scales, gaussians.quats_wxyz, T, pinhole, depth_m, rendered,
        np.float32(options.visible_within), np.float32(options.visible_share), np.float32(options.near),
        np.float32(max(options.border * min(depth_m.shape), _TINY_BORDER)), pixels, weights,
    )  # fmt: skip
    rows = np.flatnonzero(weights).astype(np.int32)
    return VisibleGaussians(rows, pixels[rows], weights[rows], depth_m.shape)


def find_visible_reference(
    gaussians: Gaussians, frame: Frame, T_world_cam: NDArray[np.float64], options: LanguageOptions
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """(N,) pixels and (N,) weights, 0 for hidden Gaussians: plain NumPy, all Gaussians at once."""
    camera, depth_m = frame.intrinsics, frame.depth_m
    height, width = depth_m.shape
    T = invert(T_world_cam)
    x, y, z = (gaussians.means.astype(np.float64) @ T[:3, :3].T + T[:3, 3]).T
    ahead = z > 0
    safe = np.where(ahead, z, 1.0)
    u, v = camera.fx * x / safe + camera.cx + 0.5, camera.fy * y / safe + camera.cy + 0.5
    inside = ahead & (u >= 0) & (v >= 0) & (u < width) & (v < height)
    column, row = np.where(inside, u, 0).astype(int), np.where(inside, v, 0).astype(int)

    ray = np.stack((x / safe, y / safe, np.ones_like(z)), axis=1)
    ray_length = np.linalg.norm(ray, axis=1)
    axes = T[:3, :3] @ quats_to_rotations(gaussians.quats_wxyz.astype(np.float64))
    along_axes = np.einsum("ni,nij->nj", ray / ray_length[:, None], axes) * gaussians.scales
    tolerance = options.visible_within + options.visible_share * z + np.linalg.norm(along_axes, axis=1)
    measured = depth_m[row, column]
    rendered = _rendered_reference(gaussians, x / safe, y / safe, z, frame)
    nearest = rendered[row // _RENDERED_PIXELS, column // _RENDERED_PIXELS]
    shown = inside & np.where(measured > 0, np.abs(measured - z) <= tolerance, z <= nearest + tolerance)

    dz_du, dz_dv = _slope(depth_m, row, column, axis=1), _slope(depth_m, row, column, axis=0)
    facing = measured + (column - camera.cx) * dz_du + (row - camera.cy) * dz_dv
    normal_length = np.sqrt((camera.fx * dz_du) ** 2 + (camera.fy * dz_dv) ** 2 + facing**2)
    cosine = measured / np.where(normal_length > 0, normal_length * ray_length, 1.0)
    cosine = np.maximum(cosine, float(_MIN_COSINE))  # for unmeasured pixels, too
    margin = np.minimum(np.minimum(row, height - 1 - row), np.minimum(column, width - 1 - column)) + 0.5
    inwards = np.minimum(1.0, margin / max(options.border * min(height, width), _TINY_BORDER))
    weight = cosine * (_EDGE + (1 - _EDGE) * inwards) / np.maximum(safe, options.near) ** 2
    return row * width + column, np.where(shown, weight, 0.0)


def _rendered_reference(
    gaussians: Gaussians, x: NDArray[np.float64], y: NDArray[np.float64], z: NDArray[np.float64], frame: Frame
) -> NDArray[np.float64]:
    """``_rendered`` with rays (x, y, 1) and depths z of the Gaussians, one at a time."""
    camera, (height, width) = frame.intrinsics, frame.depth_m.shape
    nearest = np.full((-(-height // _RENDERED_PIXELS), -(-width // _RENDERED_PIXELS)), np.inf)
    for g in np.flatnonzero(z > float(_NEAR)):
        u = (camera.fx * x[g] + camera.cx + 0.5) / _RENDERED_PIXELS
        v = (camera.fy * y[g] + camera.cy + 0.5) / _RENDERED_PIXELS
        reach = min(gaussians.scales[g].max() * camera.fx / z[g] / _RENDERED_PIXELS, _WIDEST)
        rows = slice(max(math.floor(v - reach), 0), max(math.floor(v + reach) + 1, 0))
        columns = slice(max(math.floor(u - reach), 0), max(math.floor(u + reach) + 1, 0))
        nearest[rows, columns] = np.minimum(nearest[rows, columns], z[g])
    return nearest


def _slope(
    depth_m: NDArray[np.float32], row: NDArray[np.int64], column: NDArray[np.int64], axis: int
) -> NDArray[np.float64]:
    """Change of depth per pixel along an image axis, at some pixels: over two pixels if both neighbors have a depth,
    over one pixel if one has, else 0."""
    padded = np.pad(depth_m.astype(np.float64), 1)
    down, right = (1, 0) if axis == 0 else (0, 1)
    here = padded[row + 1, column + 1]
    before, after = padded[row + 1 - down, column + 1 - right], padded[row + 1 + down, column + 1 + right]
    low, high = np.where(before > 0, before, here), np.where(after > 0, after, here)
    span = (before > 0).astype(int) + (after > 0)
    return np.asarray((high - low) / np.maximum(span, 1))


@njit(cache=True)
def _rendered(
    means: NDArray[np.float32],
    scales: NDArray[np.float32],
    T_cam_world: NDArray[np.float32],
    camera: NDArray[np.float32],
    shape: tuple[int, int],
) -> NDArray[np.float32]:
    """Depth, in blocks of pixels, of the nearest Gaussian that reaches each block within a standard deviation; infinite
    if none does."""
    height, width = -(-shape[0] // _RENDERED_PIXELS), -(-shape[1] // _RENDERED_PIXELS)
    nearest = np.full((height, width), np.float32(np.inf), np.float32)
    fx, fy, cx, cy = camera[0], camera[1], camera[2], camera[3]
    T = T_cam_world
    half, block = np.float32(0.5), np.float32(_RENDERED_PIXELS)
    for g in range(len(means)):
        X, Y, Z = means[g, 0], means[g, 1], means[g, 2]
        z = T[2, 0] * X + T[2, 1] * Y + T[2, 2] * Z + T[2, 3]
        if z <= _NEAR:
            continue
        u = (fx * (T[0, 0] * X + T[0, 1] * Y + T[0, 2] * Z + T[0, 3]) / z + cx + half) / block
        v = (fy * (T[1, 0] * X + T[1, 1] * Y + T[1, 2] * Z + T[1, 3]) / z + cy + half) / block
        reach = min(max(scales[g, 0], scales[g, 1], scales[g, 2]) * fx / z / block, np.float32(_WIDEST))
        if u + reach < 0 or v + reach < 0 or u - reach >= width or v - reach >= height:
            continue
        for row in range(max(math.floor(v - reach), 0), min(math.floor(v + reach) + 1, height)):
            for column in range(max(math.floor(u - reach), 0), min(math.floor(u + reach) + 1, width)):
                nearest[row, column] = min(nearest[row, column], z)
    return nearest


@njit(cache=True)
def _slope_between(before: np.float32, here: np.float32, after: np.float32) -> np.float32:
    """``_slope`` at one pixel."""
    if before > 0 and after > 0:
        return np.float32(0.5) * (after - before)
    if after > 0:
        return after - here
    if before > 0:
        return here - before
    return np.float32(0)


@njit(cache=True)
def _deviation_along(
    quats_wxyz: NDArray[np.float32], scales: NDArray[np.float32], x: np.float32, y: np.float32, z: np.float32
) -> np.float32:
    """Standard deviation of a Gaussian along the unit vector (x, y, z): |diag(s) R^T ray|."""
    a, b, c, d = quats_wxyz[0], quats_wxyz[1], quats_wxyz[2], quats_wxyz[3]
    two = np.float32(2)
    p = (1 - two * (c * c + d * d)) * x + two * (b * c + a * d) * y + two * (b * d - a * c) * z
    q = two * (b * c - a * d) * x + (1 - two * (b * b + d * d)) * y + two * (c * d + a * b) * z
    r = two * (b * d + a * c) * x + two * (c * d - a * b) * y + (1 - two * (b * b + c * c)) * z
    return np.float32(math.sqrt((p * scales[0]) ** 2 + (q * scales[1]) ** 2 + (r * scales[2]) ** 2))


@njit(parallel=True, cache=True)
def _see(
    means: NDArray[np.float32],
    scales: NDArray[np.float32],
    quats_wxyz: NDArray[np.float32],
    T_cam_world: NDArray[np.float32],
    camera: NDArray[np.float32],
    depth_m: NDArray[np.float32],
    rendered: NDArray[np.float32],
    within: np.float32,
    share: np.float32,
    near: np.float32,
    border: np.float32,
    pixels: NDArray[np.int32],
    weights: NDArray[np.float32],
) -> None:
    height, width = depth_m.shape
    fx, fy, cx, cy = camera[0], camera[1], camera[2], camera[3]
    T = T_cam_world
    half, one, nothing = np.float32(0.5), np.float32(1), np.float32(0)
    for g in prange(len(means)):
        X, Y, Z = means[g, 0], means[g, 1], means[g, 2]
        z = T[2, 0] * X + T[2, 1] * Y + T[2, 2] * Z + T[2, 3]
        if z <= 0:
            continue
        ray_x = (T[0, 0] * X + T[0, 1] * Y + T[0, 2] * Z + T[0, 3]) / z
        ray_y = (T[1, 0] * X + T[1, 1] * Y + T[1, 2] * Z + T[1, 3]) / z
        u, v = fx * ray_x + cx + half, fy * ray_y + cy + half
        if not (u >= 0 and v >= 0 and u < width and v < height):
            continue
        column, row = int(u), int(v)
        measured = depth_m[row, column]
        nearest = rendered[row // _RENDERED_PIXELS, column // _RENDERED_PIXELS]
        off = abs(measured - z) if measured > 0 else z - nearest
        tolerance = within + share * z
        if off > tolerance + max(scales[g, 0], scales[g, 1], scales[g, 2]):
            continue
        ray_length = np.float32(math.sqrt(ray_x * ray_x + ray_y * ray_y + one))
        if off > tolerance:  # the deviation along the ray decides
            i, j, k = ray_x / ray_length, ray_y / ray_length, one / ray_length
            deviation = _deviation_along(
                quats_wxyz[g],
                scales[g],
                T[0, 0] * i + T[1, 0] * j + T[2, 0] * k,
                T[0, 1] * i + T[1, 1] * j + T[2, 1] * k,
                T[0, 2] * i + T[1, 2] * j + T[2, 2] * k,
            )
            if off > tolerance + deviation:
                continue

        cosine = _MIN_COSINE
        if measured > 0:
            left = depth_m[row, column - 1] if column > 0 else nothing
            right = depth_m[row, column + 1] if column < width - 1 else nothing
            above = depth_m[row - 1, column] if row > 0 else nothing
            below = depth_m[row + 1, column] if row < height - 1 else nothing
            dz_du, dz_dv = _slope_between(left, measured, right), _slope_between(above, measured, below)
            facing = measured + (column - cx) * dz_du + (row - cy) * dz_dv
            normal_length = math.sqrt((fx * dz_du) ** 2 + (fy * dz_dv) ** 2 + facing * facing)
            cosine = max(np.float32(measured / (normal_length * ray_length)), _MIN_COSINE)
        margin = min(min(row, height - 1 - row), min(column, width - 1 - column))
        inwards = _EDGE + (one - _EDGE) * min(one, (np.float32(margin) + half) / border)
        pixels[g] = row * width + column
        weights[g] = cosine * inwards / max(z, near) ** 2
