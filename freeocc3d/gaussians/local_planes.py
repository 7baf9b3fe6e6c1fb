"""Fits a plane to the surroundings of each surface point: its normal, and the place that its neighbors give it.

A point p_i with the standard deviation s_i along its normal n has neighbors p_j on a surface that is nearly flat. Each
tells the plane at p_i with the weight

    w_ij = exp(-d_ij^2 / 2 h^2) g_ij / (s_j^2 + (k d_ij)^2),   g_ij = 1 / (1 + r_ij^2 / (c^2 (s_j^2 + (k d_ij)^2)))^2,

d_ij being their distance and r_ij the distance of p_j from the plane of the round before. So a neighbor on another
surface counts little (Geman and McClure's function), and so does one that is uncertain. The plane goes through the
weighted mean m of the neighbors; n is the direction of their least extent. The point then moves along n:

    p_i' = p_i + s_i^2 / (s_i^2 + v) (n^T (m - p_i)) n,   v = 1 / sum_j w_ij + e,

e being what the neighbors' mean squared distance from the plane exceeds their own variances by: the best estimate from
both. A point that many near frames
have measured stays where it is, and so do corners and thin things, whose neighbors do not lie on a plane. One that few
frames saw from afar moves to the plane of its neighbors, so that a distant wall is no thicker than a near one.

Source: M. Alexa et al., Computing and Rendering Point Set Surfaces, IEEE TVCG 9(1), 2003 (projection onto a weighted
plane); S. Geman, D. McClure, Statistical Methods for Tomographic Image Reconstruction, 1987.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import prange
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ..core.compiling import njit

_NEIGHBORS = 32
"""Nearest points, the point itself included: those within about three spacings on a surface."""

_REACH, _WIDTH = 3.0, 1.25
"""Spacings to the farthest neighbor, and h in spacings. 1 and 1.5 change IoU by 0.2 points at most."""

_BEND = 0.15
"""k: how far a surface departs from its plane, as a share of the distance. 0.3 changes IoU by 0.4 points at most."""

_OUTLIER = 2.0
"""c: deviations from which a neighbor counts as lying on another surface."""

_ROUNDS = 3
_FEWEST = 4
"""Neighbors, the point included, that make a plane; three always lie on one."""

_LEAST_SIGMA_M = 1e-3
"""Least deviation of a point, meters: depth is often stored in millimeters."""


@dataclass(frozen=True)
class LocalPlanes:
    """N points on their planes.

    points: (N, 3) float64 world, meters.  normals: (N, 3) unit vectors toward the cameras, of the planes, or of the
    viewing rays where there is no plane.  sigma_m: (N,) standard deviations of the points along the normals, meters.
    """

    points: NDArray[np.float64]
    normals: NDArray[np.float64]
    sigma_m: NDArray[np.float64]

    def __getitem__(self, rows: NDArray[np.bool_]) -> LocalPlanes:
        return LocalPlanes(self.points[rows], self.normals[rows], self.sigma_m[rows])


def fit_planes(
    points: NDArray[np.float64], sigma_m: NDArray[np.float64], rays: NDArray[np.float64], spacing: NDArray[np.floating]
) -> LocalPlanes:
    """Returns the planes at (N, 3) points, world, meters.

    sigma_m: (N,) standard deviations of the points, meters.  rays: (N, 3) directions in which they are seen, of any
    length; points seen from opposite sides are no neighbors.  spacing: (N,) distances of neighboring points, meters.
    """
    sigma_m = np.hypot(sigma_m, _LEAST_SIGMA_M)
    rays = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    if len(points) < 2:
        return LocalPlanes(points.copy(), -rays, sigma_m)
    count = min(_NEIGHBORS, len(points))
    _, neighbors = cKDTree(points).query(points, k=count, workers=-1)
    moved, normals, sigma = _fit(points, sigma_m, rays, np.asarray(spacing, np.float64), neighbors.astype(np.int32))
    return LocalPlanes(moved, normals, sigma)


@njit(parallel=True, cache=True)
def _fit(
    points: NDArray[np.float64],
    sigma_m: NDArray[np.float64],
    rays: NDArray[np.float64],
    spacing: NDArray[np.float64],
    neighbors: NDArray[np.int32],
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    n, count = neighbors.shape
    moved, normals, sigma = points.copy(), -rays, sigma_m.copy()
    for i in prange(n):
        place, inverse, weight, variance = np.empty((count, 3)), np.empty(count), np.empty(count), np.empty(count)
        used = 0
        for neighbor in neighbors[i]:
            squared, facing = 0.0, 0.0
            for a in range(3):
                place[used, a] = points[neighbor, a] - points[i, a]
                squared += place[used, a] * place[used, a]
                facing += rays[neighbor, a] * rays[i, a]
            if facing < 0 or squared > (_REACH * spacing[i]) ** 2:
                continue
            variance[used] = sigma_m[neighbor] ** 2
            inverse[used] = 1.0 / (variance[used] + _BEND * _BEND * squared)
            weight[used] = math.exp(-0.5 * squared / (_WIDTH * spacing[i]) ** 2) * inverse[used]
            used += 1
        if used < _FEWEST:
            continue
        mean, normal = np.zeros(3), np.zeros(3)
        total, noise, extent = 0.0, 0.0, 0.0
        for turn in range(_ROUNDS):
            S = np.zeros(6)
            next_mean = np.zeros(3)
            total, noise = 0.0, 0.0
            for q in range(used):
                w = weight[q]
                if turn > 0:
                    off = 0.0
                    for a in range(3):
                        off += normal[a] * (place[q, a] - mean[a])
                    w /= (1.0 + off * off * inverse[q] / _OUTLIER**2) ** 2
                total += w
                noise += w * variance[q]
                entry = 0
                for a in range(3):
                    next_mean[a] += w * place[q, a]
                    for b in range(a, 3):
                        S[entry] += w * place[q, a] * place[q, b]
                        entry += 1
            entry = 0
            for a in range(3):
                mean[a] = next_mean[a] / total
            for a in range(3):
                for b in range(a, 3):
                    S[entry] = S[entry] / total - mean[a] * mean[b]
                    entry += 1
            extent = _least_axis(S, normal)
        toward = normal[0] * rays[i, 0] + normal[1] * rays[i, 1] + normal[2] * rays[i, 2]
        own, distance = sigma_m[i] ** 2, 0.0
        for a in range(3):
            normals[i, a] = -normal[a] if toward > 0 else normal[a]
            distance += normal[a] * mean[a]
        share = own / (own + 1.0 / total + max(extent - noise / total, 0.0))
        for a in range(3):
            moved[i, a] += share * distance * normal[a]
        sigma[i] = math.sqrt(own / (1.0 + own * total))
    return moved, normals, sigma


@njit(cache=True)
def _least_axis(S: NDArray[np.float64], axis: NDArray[np.float64]) -> float:
    """Writes the unit eigenvector of the least eigenvalue to ``axis`` (3,), and returns the eigenvalue, at least 0.

    S: (6,) xx, xy, xz, yy, yz, zz.  Source: O. Smith, Eigenvalues of a Symmetric 3 x 3 Matrix, CACM 4(4), 1961.
    """
    xx, xy, xz, yy, yz, zz = S[0], S[1], S[2], S[3], S[4], S[5]
    third = (xx + yy + zz) / 3.0
    a, b, c = xx - third, yy - third, zz - third
    scale = math.sqrt((a * a + b * b + c * c + 2.0 * (xy * xy + xz * xz + yz * yz)) / 6.0)
    least = third
    if scale > 0.0:
        half = (a * (b * c - yz * yz) - xy * (xy * c - yz * xz) + xz * (xy * yz - b * xz)) / (2.0 * scale**3)
        least = third + 2.0 * scale * math.cos((math.acos(min(max(half, -1.0), 1.0)) + 2.0 * math.pi) / 3.0)
    rows = ((xx - least, xy, xz), (xy, yy - least, yz), (xz, yz, zz - least))
    best = 0.0
    for p, q in ((0, 1), (0, 2), (1, 2)):  # the axis is orthogonal to all rows
        u, v = rows[p], rows[q]
        x, y, z = u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]
        length = math.sqrt(x * x + y * y + z * z)
        if length > best:
            best = length
            axis[0], axis[1], axis[2] = x / length, y / length, z / length
    if best == 0.0:  # points on a line or in one place: any direction across
        axis[0], axis[1], axis[2] = 0.0, 0.0, 1.0
    return max(least, 0.0)
