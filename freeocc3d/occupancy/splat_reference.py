"""The projection in plain NumPy and SciPy, which evaluates every pair: the reference for tests of ``splat``."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..core.transforms import quats_to_rotations
from ..core.types import Gaussians
from .splat import _EVEN, _SPACED, Options


def compute_contributions_reference(
    gaussians: Gaussians, points: NDArray[np.float64], options: Options, least_scale: float = 0.0
) -> NDArray[np.float64]:
    """Returns the (P, N) c_k at voxels. points: (P, 3) centers of the voxels in the world.  least_scale: s_min, which
    "integrated" and "released" ignore. The cutoff applies, except for "released": there the neighborhood is all space.
    """
    if options.projection == "integrated":
        middle, most = np.sort(gaussians.scales.astype(np.float64), axis=1).T[1:]
        share = middle * most / (_SPACED * 0.5 * options.voxel_size) ** 2
        return np.asarray(1 - (1 - measure_masses_reference(gaussians, points, options)) ** share)
    o = gaussians.opacities.astype(np.float64)
    if options.projection == "released":
        R = quats_to_rotations(gaussians.quats_wxyz.astype(np.float64))
        offset = points[:, None] - gaussians.means.astype(np.float64)[None]
        squared = ((np.einsum("pni,nij->pnj", offset, R) * gaussians.scales) ** 2).sum(axis=2)
        return np.asarray(1 - np.exp(-o * np.exp(-0.5 * squared)))
    wide = replace(gaussians, scales=np.maximum(gaussians.scales, least_scale))
    squared = _squared_distances(wide, points)
    volumes = (g.scales.astype(np.float64).prod(axis=1) for g in (gaussians, wide))
    phi = np.where(squared <= options.cutoff**2, np.exp(-0.5 * squared), 0.0) * np.divide(*volumes) ** (2 / 3)
    return phi if options.projection == "probabilistic" else np.asarray(1 - np.exp(-o * phi))


def compute_probability_reference(
    gaussians: Gaussians, points: NDArray[np.float64], options: Options, least_scale: float = 0.0
) -> NDArray[np.float64]:
    """Returns the (P,) alpha of voxels at their centers: equation (B)."""
    return np.asarray(
        1.0 - np.prod(1.0 - compute_contributions_reference(gaussians, points, options, least_scale), axis=1)
    )


def compute_posterior_mean_reference(
    gaussians: Gaussians, points: NDArray[np.float64], values: NDArray[np.floating], options: Options
) -> NDArray[np.float64]:
    """Returns the (P, D) posterior means of values (N, D) at the centers of voxels: equations (C) and (D)."""
    o = gaussians.opacities.astype(np.float64)
    if options.projection == "integrated":
        weight = measure_masses_reference(gaussians, points, options) * o
    elif options.projection == "released":
        weight = -np.log(1 - compute_contributions_reference(gaussians, points, options))
    else:
        squared = _squared_distances(gaussians, points)
        density = np.exp(-0.5 * squared) / gaussians.scales.astype(np.float64).prod(axis=1)
        weight = np.where(squared <= options.cutoff**2, density, 0.0) * o
    total = weight.sum(axis=1, keepdims=True)
    return np.asarray((weight / np.where(total > 0, total, 1.0)) @ values)


def _squared_distances(gaussians: Gaussians, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """(P, N) squared Mahalanobis distances."""
    R = quats_to_rotations(gaussians.quats_wxyz.astype(np.float64))
    offset = points[:, None] - gaussians.means.astype(np.float64)[None]
    along_axes = np.einsum("pni,nij->pnj", offset, R) / gaussians.scales.astype(np.float64)
    return np.asarray((along_axes**2).sum(axis=2))


def measure_masses_reference(
    gaussians: Gaussians, points: NDArray[np.float64], options: Options
) -> NDArray[np.float64]:
    """Returns the (P, N) mass of each Gaussian, as narrow as an even sheet allows, in the voxel around each point, by
    SciPy's quadrature; 0 where the voxel does not touch the Gaussian's bounding box at the cutoff."""
    from scipy.stats import multivariate_normal

    half = 0.5 * options.voxel_size
    masses = np.zeros((len(points), len(gaussians)))
    R = quats_to_rotations(gaussians.quats_wxyz.astype(np.float64))
    for n, scales in enumerate(gaussians.scales.astype(np.float64)):
        mean, axes = gaussians.means[n].astype(np.float64), R[n] * np.clip(scales * _EVEN / _SPACED, scales.min(), None)
        covariance = axes @ axes.T
        near = (np.abs(points - mean) <= half + options.cutoff * np.sqrt(np.diag(covariance))).all(axis=1)
        for p in np.flatnonzero(near):
            masses[p, n] = multivariate_normal.cdf(
                points[p] + half, mean, covariance, lower_limit=points[p] - half, abseps=1e-6, releps=1e-6
            )
    return masses
