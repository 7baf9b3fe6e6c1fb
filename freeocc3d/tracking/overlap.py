"""Measures how much of the view of one depth image another camera also sees."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

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
    pixels, z = project(transform(T_b_a, points_a), b.intrinsics)
    height, width = b.depth_m.shape
    with np.errstate(invalid="ignore"):  # points behind the camera project to NaN, which counts as outside
        inside = (pixels > -0.5).all(axis=1) & (pixels < (width - 0.5, height - 0.5)).all(axis=1)
    u, v = np.rint(pixels[inside]).astype(int).T
    depth = b.depth_m[v, u]
    agrees = (depth == 0) | (np.abs(depth - z[inside]) < _SAME_DEPTH * z[inside])
    return float(agrees.sum() / len(points_a))
