"""Lifts image features onto the Gaussians that an image shows, and fuses them over keyframes.

Paper, Sec. "Open-vocabulary Semantic Association": per-pixel embeddings z_t(u) are lifted to 3D with the depth and
attached to the Gaussian anchored there. Here each Gaussian collects them from every keyframe that sees it:

    f_k = sum_t w_t z_t(u_t) / |sum_t w_t z_t(u_t)|,   u_t the pixel of mu_k in keyframe t,

over the keyframes whose depth image d_t shows the Gaussian, |d_t(u_t) - z| <= tolerance, with w_t = cos(theta) / z^2:
a near and frontal view has more pixels on the surface. theta is the angle between the viewing ray and the normal that
the depth image has at u_t.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from ..errors import ConfigError
from ..geometry import invert, quats_to_rotations
from ..registry import require_positive
from ..types import Frame, Gaussians

_MIN_COSINE = np.float32(0.05)
"""Of a view along the surface, and of one next to a depth edge, where pixels mix both sides."""


@dataclass(frozen=True)
class Options:
    """Layer 3: what is known of the Gaussians in words."""

    encoder: str = "colour"
    """What turns images and words into features; "colour" needs no network and knows colour names only."""
    visible_within: float = 0.02
    """A Gaussian is seen if the depth image shows something within this many metres of it…"""
    visible_share: float = 0.01
    """…plus this share of its depth, plus its own standard deviation along the ray; otherwise it is hidden."""
    near: float = 0.5
    """Views count in proportion to 1 / depth^2, those nearer than this all the same, metres."""

    def __post_init__(self) -> None:
        require_positive(self, "visible_within", "near")
        if self.visible_share < 0:
            raise ConfigError(f"'visible_share' must not be negative, got {self.visible_share}.")


class FeatureFusion:
    """Running weighted mean of the features of N Gaussians; the order of views matters only to rounding.

    Memory: 4 D + 4 bytes a Gaussian (float32 ``sum`` (N, D) and ``weights`` (N,)).
    """

    def __init__(self, n_gaussians: int, dimension: int, options: Options | None = None):
        self.options = options or Options()
        self.sum = np.zeros((n_gaussians, dimension), np.float32)
        self.weights = np.zeros(n_gaussians, np.float32)

    def add(
        self, gaussians: Gaussians, frame: Frame, T_world_cam: NDArray[np.float64], features: NDArray[np.float16]
    ) -> None:
        """Fuse the (h, w, D) features of one frame, which cover its image evenly; zero features say nothing."""
        camera, options = frame.intrinsics, self.options
        _fuse(
            gaussians.means, gaussians.scales, gaussians.quats_wxyz, invert(T_world_cam).astype(np.float32),
            np.array((camera.fx, camera.fy, camera.cx, camera.cy), np.float32), frame.depth_m,
            np.ascontiguousarray(features, np.float32), np.float32(options.visible_within),
            np.float32(options.visible_share), np.float32(options.near), self.sum, self.weights,
        )  # fmt: skip

    def features(self) -> NDArray[np.float16]:
        """(N, D) unit features; zero for a Gaussian that no view had anything to say of."""
        norms = np.linalg.norm(self.sum, axis=1, keepdims=True)
        return (self.sum / np.where(norms > 0, norms, 1)).astype(np.float16)


def lift_reference(
    gaussians: Gaussians,
    frame: Frame,
    T_world_cam: NDArray[np.float64],
    features: NDArray[np.floating],
    options: Options,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(N, D) weighted features and (N,) weights that one frame adds: plain NumPy, all Gaussians at once."""
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
    seen = inside & (measured > 0) & (np.abs(measured - z) <= tolerance)

    dz_du, dz_dv = _slope(depth_m, row, column, axis=1), _slope(depth_m, row, column, axis=0)
    facing = measured + (column - camera.cx) * dz_du + (row - camera.cy) * dz_dv
    normal_length = np.sqrt((camera.fx * dz_du) ** 2 + (camera.fy * dz_dv) ** 2 + facing**2)
    cosine = np.maximum(measured / np.where(normal_length > 0, normal_length * ray_length, 1.0), float(_MIN_COSINE))

    h, w = features.shape[:2]
    feature = features[row * h // height, column * w // width].astype(np.float64)
    weight = np.where(seen & feature.any(axis=1), cosine / np.maximum(safe, options.near) ** 2, 0.0)
    return weight[:, None] * feature, weight


def _slope(
    depth_m: NDArray[np.float32], row: NDArray[np.int64], column: NDArray[np.int64], axis: int
) -> NDArray[np.float64]:
    """Depth per pixel along an image axis, at some pixels: over two pixels where both neighbours are measured, over
    one where one is, else 0."""
    padded = np.pad(depth_m.astype(np.float64), 1)
    down, right = (1, 0) if axis == 0 else (0, 1)
    here = padded[row + 1, column + 1]
    before, after = padded[row + 1 - down, column + 1 - right], padded[row + 1 + down, column + 1 + right]
    low, high = np.where(before > 0, before, here), np.where(after > 0, after, here)
    span = (before > 0).astype(int) + (after > 0)
    return np.asarray((high - low) / np.maximum(span, 1))


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
def _fuse(
    means: NDArray[np.float32],
    scales: NDArray[np.float32],
    quats_wxyz: NDArray[np.float32],
    T_cam_world: NDArray[np.float32],
    camera: NDArray[np.float32],
    depth_m: NDArray[np.float32],
    features: NDArray[np.float32],
    within: np.float32,
    share: np.float32,
    near: np.float32,
    total: NDArray[np.float32],
    weights: NDArray[np.float32],
) -> None:
    height, width = depth_m.shape
    h, w, dimension = features.shape
    fx, fy, cx, cy = camera[0], camera[1], camera[2], camera[3]
    T = T_cam_world
    half, one = np.float32(0.5), np.float32(1)
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
        off = abs(measured - z)
        tolerance = within + share * z
        if measured <= 0 or off > tolerance + max(scales[g, 0], scales[g, 1], scales[g, 2]):
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

        left = depth_m[row, column - 1] if column > 0 else np.float32(0)
        right = depth_m[row, column + 1] if column < width - 1 else np.float32(0)
        above = depth_m[row - 1, column] if row > 0 else np.float32(0)
        below = depth_m[row + 1, column] if row < height - 1 else np.float32(0)
        dz_du, dz_dv = _slope_between(left, measured, right), _slope_between(above, measured, below)
        facing = measured + (column - cx) * dz_du + (row - cy) * dz_dv
        normal_length = math.sqrt((fx * dz_du) ** 2 + (fy * dz_dv) ** 2 + facing * facing)
        cosine = max(np.float32(measured / (normal_length * ray_length)), _MIN_COSINE)

        feature = features[row * h // height, column * w // width]
        weight = cosine / max(z, near) ** 2
        known = False
        for d in range(dimension):
            if feature[d] != 0:
                known = True
                total[g, d] += weight * feature[d]
        if known:
            weights[g] += weight
