"""Measures how much of the view of one depth image another camera also sees."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..core.compiling import njit
from ..core.transforms import back_project, invert, project, transform
from ..core.types import Intrinsics

_SAME_DEPTH = 0.1  # largest relative difference of two depths of one surface, with drifting poses


def sample_points(depth_m: NDArray[np.float32], intrinsics: Intrinsics, step: int = 8) -> NDArray[np.float32]:
    """Back-project every ``step``-th pixel with a depth to (P, 3) camera-frame points."""
    v, u = np.mgrid[step // 2 : depth_m.shape[0] : step, step // 2 : depth_m.shape[1] : step]
    depth = depth_m[v, u]
    valid = depth > 0
    pixels = np.stack((u[valid], v[valid]), axis=-1).astype(np.float32)
    return np.asarray(back_project(pixels, depth[valid], intrinsics), np.float32)


@dataclass(frozen=True)
class DepthView:
    """A depth image (H, W), meters, its camera, and a sample (P, 3) of its points in the camera frame."""

    depth_m: NDArray[np.float32]
    intrinsics: Intrinsics
    points: NDArray[np.float32]


def measure_mutual_overlap(a: DepthView, b: DepthView, T_b_a: NDArray[np.float64]) -> float:
    """The smaller of the two overlaps, of a in b and of b in a. It falls both when the camera turns away and when it
    steps back."""
    return min(measure_overlap(a.points, T_b_a, b), measure_overlap(b.points, invert(T_b_a), a))


def measure_overlap(points_a: NDArray[np.float32], T_b_a: NDArray[np.float64], b: DepthView) -> float:
    """Share of camera a's points that camera b also sees: a point projects into b's image, and b's depth there is
    missing or agrees within 10 %. 0 if there are no points."""
    if len(points_a) == 0:
        return 0.0
    camera = b.intrinsics
    depth_m = np.ascontiguousarray(b.depth_m)
    return float(_count_seen(points_a, T_b_a, depth_m, camera.fx, camera.fy, camera.cx, camera.cy) / len(points_a))


def measure_overlap_reference(points_a: NDArray[np.float32], T_b_a: NDArray[np.float64], b: DepthView) -> float:
    """``measure_overlap`` in plain NumPy, for at least one point."""
    pixels, z = project(transform(T_b_a, points_a.astype(np.float64)), b.intrinsics)
    height, width = b.depth_m.shape
    with np.errstate(invalid="ignore"):  # points behind the camera project to NaN, which counts as outside
        inside = (pixels > -0.5).all(axis=1) & (pixels < (width - 0.5, height - 0.5)).all(axis=1)
    u, v = np.rint(pixels[inside]).astype(int).T
    depth = b.depth_m[v, u]
    agrees = (depth == 0) | (np.abs(depth - z[inside]) < _SAME_DEPTH * z[inside])
    return float(agrees.sum() / len(points_a))


@njit(nogil=True, cache=True)
def _count_seen(
    points: NDArray[np.float32],
    T: NDArray[np.float64],
    depth_m: NDArray[np.float32],
    fx: float,
    fy: float,
    cx: float,
    cy: float,
) -> int:
    """Number of points, transformed by T, that the camera sees."""
    height, width = depth_m.shape
    seen = 0
    for n in range(len(points)):
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        depth = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
        if not depth > 0:
            continue
        u = fx * (T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]) / depth + cx
        v = fy * (T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]) / depth + cy
        if not (u > -0.5 and v > -0.5 and u < width - 0.5 and v < height - 0.5):
            continue
        found = depth_m[int(v + 0.5), int(u + 0.5)]
        if found == 0 or abs(found - depth) < _SAME_DEPTH * depth:
            seen += 1
    return seen
