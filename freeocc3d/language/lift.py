"""Lifts image features onto the Gaussians that an image shows, and fuses them over keyframes.

Paper, Sec. "Open-vocabulary Semantic Association": per-pixel embeddings z_t(u) are lifted to 3D with the depth and
attached to the Gaussian anchored there. Here each Gaussian collects them from every keyframe that sees it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from ..geometry import invert
from ..registry import require_positive
from ..types import Frame, Gaussians


@dataclass(frozen=True)
class Options:
    """Layer 3."""

    encoder: str = "colour"
    """What turns images and words into features; "colour" needs no network and knows colour names only."""
    visible_within: float = 0.05
    """A Gaussian is seen if the depth image shows something within this many metres of it…"""
    visible_share: float = 0.02
    """…plus this share of its depth; otherwise it is hidden."""
    near: float = 0.5
    """Views count in proportion to 1 / depth^2, those nearer than this all the same, metres."""

    def __post_init__(self) -> None:
        require_positive(self, "visible_within", "near")


class FeatureFusion:
    """Running weighted mean of the features of N Gaussians; order of views matters only to rounding.

    Memory: 4 D + 4 bytes a Gaussian (float32 sum and weight).
    """

    def __init__(self, n_gaussians: int, dimension: int, options: Options):
        self.options = options
        self.sum = np.zeros((n_gaussians, dimension), np.float32)
        self.weight = np.zeros(n_gaussians, np.float32)

    def add(
        self, gaussians: Gaussians, frame: Frame, T_world_cam: NDArray[np.float64], features: NDArray[np.float16]
    ) -> None:
        """Fuse the (h, w, D) features of one frame, which cover its image evenly."""
        T = invert(T_world_cam).astype(np.float32)
        camera = frame.intrinsics
        _fuse(
            gaussians.means, T, np.array((camera.fx, camera.fy, camera.cx, camera.cy), np.float32), frame.depth_m,
            np.ascontiguousarray(features, np.float32), np.float32(self.options.visible_within),
            np.float32(self.options.visible_share), np.float32(self.options.near), self.sum, self.weight,
        )  # fmt: skip

    def features(self) -> NDArray[np.float16]:
        """(N, D) unit features; zero for a Gaussian that no view had anything to say of."""
        norms = np.linalg.norm(self.sum, axis=1, keepdims=True)
        return (self.sum / np.where(norms > 0, norms, 1)).astype(np.float16)


@njit(parallel=True, cache=True)
def _fuse(
    means: NDArray[np.float32],
    T_cam_world: NDArray[np.float32],
    camera: NDArray[np.float32],
    depth_m: NDArray[np.float32],
    features: NDArray[np.float32],
    within: np.float32,
    share: np.float32,
    near: np.float32,
    total: NDArray[np.float32],
    weight: NDArray[np.float32],
) -> None:
    height, width = depth_m.shape
    rows, columns, dimension = features.shape
    R, t = T_cam_world[:3, :3], T_cam_world[:3, 3]
    for g in prange(len(means)):
        x, y, z = means[g, 0], means[g, 1], means[g, 2]
        depth = R[2, 0] * x + R[2, 1] * y + R[2, 2] * z + t[2]
        if depth <= 0:
            continue
        u = camera[0] * (R[0, 0] * x + R[0, 1] * y + R[0, 2] * z + t[0]) / depth + camera[2] + np.float32(0.5)
        v = camera[1] * (R[1, 0] * x + R[1, 1] * y + R[1, 2] * z + t[1]) / depth + camera[3] + np.float32(0.5)
        if not (u >= 0 and v >= 0 and u < width and v < height):
            continue
        measured = depth_m[int(v), int(u)]
        if measured <= 0 or abs(measured - depth) > within + share * depth:
            continue
        row, column = min(int(v * rows / height), rows - 1), min(int(u * columns / width), columns - 1)
        w = np.float32(1) / max(depth, near) ** 2
        known = False
        for d in range(dimension):
            value = features[row, column, d]
            if value != 0:
                known = True
                total[g, d] += w * value
        if known:
            weight[g] += w


def fuse_reference(
    gaussians: Gaussians,
    frame: Frame,
    T_world_cam: NDArray[np.float64],
    features: NDArray[np.float16],
    options: Options,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(N, D) weighted features and (N,) weights that one frame adds: the same in plain NumPy."""
    camera = frame.intrinsics
    T = invert(T_world_cam)
    points = gaussians.means.astype(np.float64) @ T[:3, :3].T + T[:3, 3]
    total, weight = np.zeros((len(points), features.shape[2])), np.zeros(len(points))
    for g, (x, y, z) in enumerate(points):
        if z <= 0:
            continue
        u, v = camera.fx * x / z + camera.cx + 0.5, camera.fy * y / z + camera.cy + 0.5
        if not (0 <= u < camera.width and 0 <= v < camera.height):
            continue
        measured = frame.depth_m[math.floor(v), math.floor(u)]
        if measured <= 0 or abs(measured - z) > options.visible_within + options.visible_share * z:
            continue
        row, column = int(v * features.shape[0] / camera.height), int(u * features.shape[1] / camera.width)
        feature = features[row, column].astype(np.float64)
        w = 1.0 / max(z, options.near) ** 2
        total[g] = w * feature
        weight[g] = w * bool(feature.any())
    return total, weight
