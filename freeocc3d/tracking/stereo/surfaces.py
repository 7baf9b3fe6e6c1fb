"""Planes that a room's walls, floors and tables lie in, and which of them each pixel of a view shows.

Where a wall has no texture, no photograph says how far it is; its edges and what hangs on it do. Source of the idea:
D. Gallup, J.-M. Frahm, M. Pollefeys, Piecewise Planar and Non-Planar Stereo for Urban Scene Reconstruction, CVPR 2010.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

_SAMPLE = 3000  # points on which hypotheses are tried
_TRIES = 200
_REACH = (0.1, 0.5)  # of its depth: how far from the first the other two points of a hypothesis may lie
_WITHIN = 2.5  # standard deviations of a point
_INDEPENDENT = 50.0  # points per independent measurement: patches overlap, and views see the same


@dataclass(frozen=True)
class Plane:
    """The points X of a camera's frame with ``normal`` · X = 1: there the inverse depth is ``normal`` · ray.

    normal: (3,) float64, 1 / metres.  covariance: (3, 3) of ``normal``.
    """

    normal: NDArray[np.float64]
    covariance: NDArray[np.float64]


def find_planes(
    points: NDArray[np.float64], sigma_m: NDArray[np.float64], most: int, least_share: float, seed: int = 0
) -> list[Plane]:
    """The planes that hold most points, found one after the other; what one holds the next ones do without.

    points: (N, 3) in a camera's frame.  sigma_m: (N,) metres.  least_share: of all points, that a plane must hold.
    Source: M. Fischler, R. Bolles, Random Sample Consensus, 1981.
    """
    rng = np.random.default_rng(seed)
    left = np.arange(len(points))
    least = max(30, int(least_share * len(points)))
    planes: list[Plane] = []
    while len(planes) < most and len(left) >= least:
        plane = _best_plane(points[left], sigma_m[left], rng)
        if plane is None:
            break
        distance = np.abs(points[left] @ plane.normal - 1.0) / np.linalg.norm(plane.normal) / sigma_m[left]
        if np.count_nonzero(distance < _WITHIN) < least:
            break
        planes.append(plane)
        left = left[distance >= _WITHIN]
    return planes


def _best_plane(points: NDArray[np.float64], sigma_m: NDArray[np.float64], rng: np.random.Generator) -> Plane | None:
    chosen = rng.permutation(len(points))[:_SAMPLE]
    tried, within = points[chosen], _WITHIN * sigma_m[chosen]
    corners = tried[_triples(tried, rng)]  # (T, 3, 3)
    volume = np.abs(np.linalg.det(corners)) / np.linalg.norm(corners, axis=2).prod(axis=1)
    corners = corners[volume > 1e-4]  # flat seen from the camera: no plane that it sees
    if not len(corners):
        return None
    normals = np.linalg.solve(corners, np.ones((len(corners), 3, 1)))[..., 0]
    length = np.linalg.norm(normals, axis=1)
    held = np.abs(tried @ normals.T - 1.0) < within[:, None] * length
    normal = normals[np.argmax(held.sum(axis=0))]
    covariance = np.eye(3)
    for _ in range(3):
        length = float(np.linalg.norm(normal))
        inside = np.abs(points @ normal - 1.0) < _WITHIN * sigma_m * length
        if np.count_nonzero(inside) < 30:
            return None
        weight = 1.0 / (sigma_m[inside] * length)
        rows = points[inside] * weight[:, None]
        information = rows.T @ rows
        normal = np.linalg.solve(information, rows.T @ weight)
        spread = np.mean((rows @ normal - weight) ** 2)
        covariance = np.linalg.inv(information) * max(float(spread), 0.1) * _INDEPENDENT
    return Plane(normal, covariance)


def _triples(points: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.int64]:
    """(T, 3) rows of points that lie near each other, at several scales."""
    first = rng.integers(len(points), size=_TRIES)
    reach = np.abs(points[first, 2]) * rng.uniform(*_REACH, _TRIES)
    near = np.linalg.norm(points[None] - points[first][:, None], axis=2) < reach[:, None]
    draw = np.where(near, rng.random(near.shape, np.float32), -1.0)
    others = np.argpartition(draw, -2, axis=1)[:, -2:]
    return np.concatenate((first[:, None], others), axis=1)
