"""Rigid and similarity transforms, quaternions, pinhole projection. NumPy only; poses are ``T_to_from`` (4, 4)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .errors import FreeOccError
from .types import Intrinsics

Array = NDArray[Any]


def invert(T_a_b: Array) -> Array:
    """Invert rigid transforms: (..., 4, 4) T_a_b to (..., 4, 4) T_b_a."""
    R = np.swapaxes(T_a_b[..., :3, :3], -1, -2)
    out = np.zeros_like(T_a_b)
    out[..., :3, :3] = R
    out[..., :3, 3] = -(R @ T_a_b[..., :3, 3:])[..., 0]
    out[..., 3, 3] = 1.0
    return out


def transform(T_a_b: Array, points_b: Array) -> Array:
    """Transform points (..., 3) from frame b to frame a by (4, 4) T_a_b. Keeps the points' dtype."""
    T = np.asarray(T_a_b, points_b.dtype)
    return points_b @ T[:3, :3].T + T[:3, 3]


def is_rigid(T: Array, tolerance: float = 1e-3) -> bool:
    """Whether a (4, 4) matrix is finite, has last row (0, 0, 0, 1) and a rotation of determinant +1."""
    if T.shape != (4, 4) or not np.isfinite(T).all() or np.abs(T[3] - (0, 0, 0, 1)).max() > tolerance:
        return False
    R = T[:3, :3]
    return bool(np.abs(R @ R.T - np.eye(3)).max() < tolerance and np.linalg.det(R) > 0)


def nearest_rigid(T: Array) -> Array:
    """The rigid (4, 4) transform whose rotation is closest to that of ``T`` in the Frobenius norm. Composing estimates
    doubles the orthonormality error of a rotation at every frame, so each estimate is corrected before use.
    """
    U, _, Vt = np.linalg.svd(T[:3, :3])
    out = np.eye(4)
    out[:3, :3] = U @ np.diag((1.0, 1.0, np.linalg.det(U @ Vt))) @ Vt
    out[:3, 3] = T[:3, 3]
    return out


def quats_to_rotations(quats_wxyz: ArrayLike) -> Array:
    """Convert unit quaternions (..., 4) wxyz to rotation matrices (..., 3, 3)."""
    w, x, y, z = np.moveaxis(np.asarray(quats_wxyz), -1, 0)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def rotations_to_quats(R: ArrayLike) -> Array:
    """Convert rotation matrices (..., 3, 3) to unit quaternions (..., 4) wxyz with w >= 0. Shepperd's method computes
    the largest squared component first, to avoid a division by a small number."""
    R = np.asarray(R)
    m00, m11, m22 = R[..., 0, 0], R[..., 1, 1], R[..., 2, 2]
    squares = np.stack((1 + m00 + m11 + m22, 1 + m00 - m11 - m22, 1 - m00 + m11 - m22, 1 - m00 - m11 + m22), -1)
    wx, wy, wz = R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]
    xy, xz, yz = R[..., 0, 1] + R[..., 1, 0], R[..., 0, 2] + R[..., 2, 0], R[..., 1, 2] + R[..., 2, 1]
    candidates = np.stack(
        [
            np.stack((squares[..., 0], wx, wy, wz), -1),
            np.stack((wx, squares[..., 1], xy, xz), -1),
            np.stack((wy, xy, squares[..., 2], yz), -1),
            np.stack((wz, xz, yz, squares[..., 3]), -1),
        ],
        axis=-2,
    )
    best = np.argmax(squares, axis=-1)[..., None, None]
    quats = np.take_along_axis(candidates, best, axis=-2)[..., 0, :]
    quats = quats / np.linalg.norm(quats, axis=-1, keepdims=True)
    return np.where(quats[..., :1] < 0, -quats, quats)


def multiply_quats(a_wxyz: Array, b_wxyz: Array) -> Array:
    """Hamilton product, (..., 4) x (..., 4): the rotation b followed by the rotation a."""
    aw, ax, ay, az = np.moveaxis(a_wxyz, -1, 0)
    bw, bx, by, bz = np.moveaxis(b_wxyz, -1, 0)
    return np.stack(
        (
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ),
        axis=-1,
    )


def project(points_cam: Array, intrinsics: Intrinsics) -> tuple[Array, Array]:
    """Project camera-frame points (..., 3) to pixels (..., 2) and depths (...,). Pixels are NaN where z <= 0."""
    z = points_cam[..., 2]
    safe = np.where(z > 0, z, np.nan)
    u = intrinsics.fx * points_cam[..., 0] / safe + intrinsics.cx
    v = intrinsics.fy * points_cam[..., 1] / safe + intrinsics.cy
    return np.stack((u, v), axis=-1), z


def back_project(pixels: Array, depth_m: Array, intrinsics: Intrinsics) -> Array:
    """Back-project pixels (..., 2) with depths (...,) in meters to camera-frame points (..., 3)."""
    x = (pixels[..., 0] - intrinsics.cx) / intrinsics.fx * depth_m
    y = (pixels[..., 1] - intrinsics.cy) / intrinsics.fy * depth_m
    return np.stack((x, y, depth_m), axis=-1)


_STRAIGHT = 0.005
"""Points lie on a line if their second principal spread is a smaller share of the first. The rotation about that line
would come from the jitter of the trajectory, not from its shape."""


def umeyama(source: Array, target: Array, with_scale: bool) -> tuple[float, Array, Array]:
    """The similarity (s, R, t) that minimizes sum |target - (s R source + t)|^2 over (N, 3) point pairs.

    Source: S. Umeyama, Least-Squares Estimation of Transformation Parameters Between Two Point Patterns, PAMI 1991;
    equation numbers below are from that paper. Raises FreeOccError for fewer than three pairs or for collinear points,
    which do not determine the rotation.
    """
    if len(source) < 3:
        raise FreeOccError(f"Alignment needs at least 3 matched poses, got {len(source)}: check that timestamps match.")
    mean_source, mean_target = source.mean(axis=0), target.mean(axis=0)
    centered_source, centered_target = source - mean_source, target - mean_target
    variance = (centered_source**2).sum() / len(source)  # eq. 36
    covariance = centered_target.T @ centered_source / len(source)  # eq. 38
    for points in (centered_source, centered_target):
        spread = np.linalg.svd(points, compute_uv=False)
        if spread[1] <= _STRAIGHT * spread[0]:
            raise FreeOccError("Alignment is not determined: all camera centers lie at one point or on one line.")
    U, D, Vt = np.linalg.svd(covariance)
    S = np.eye(3)
    if np.linalg.det(U) * np.linalg.det(Vt) < 0:
        S[2, 2] = -1.0  # eq. 39
    R = U @ S @ Vt  # eq. 40
    scale = float((D * np.diag(S)).sum() / variance) if with_scale else 1.0  # eq. 42
    return scale, R, mean_target - scale * R @ mean_source  # eq. 41


def measure_pose_difference(T_a: Array, T_b: Array) -> tuple[float, float]:
    """Difference of two poses of the same object: meters and degrees."""
    difference = invert(T_a) @ T_b
    cosine = np.clip(0.5 * (np.trace(difference[:3, :3]) - 1.0), -1.0, 1.0)
    return float(np.linalg.norm(difference[:3, 3])), float(np.degrees(np.arccos(cosine)))
