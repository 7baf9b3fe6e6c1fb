"""Gaussian-to-occupancy projection (paper, Sec. "Gaussian-to-Occupancy Projection") over sparse voxel blocks.

Every mode is a product over the neighboring Gaussians H(x) of a voxel with center x and box V(x),

    alpha(x) = 1 - prod_{k in H(x)} (1 - c_k(x)),                                                             (B)

with phi_k(x) = exp(-1/2 (x - mu_k)^T Sigma_k^-1 (x - mu_k)), Sigma_k = R(r_k) diag(s_k^2) R(r_k)^T, and

    probabilistic   c_k = phi_k(x): the paper's, opacity is not part of it                                     (A)
    poisson         c_k = 1 - exp(-o_k phi_k(x)), so that alpha = 1 - exp(-sum_k o_k phi_k(x))
    integrated      c_k = the mass of N(mu_k, Sigma_k) within V(x)
    released        as poisson, with Sigma_k (m^2) where Sigma_k^-1 belongs: the paper's code as it seems to run. phi is
                    1 in all of H(x), in effect a dilation by it; for comparison.

and the features of the voxel are posterior means,

    p(G_k | x) = w_k(x) / sum_j w_j(x),  w_k = N(x; mu_k, Sigma_k) o_k  (integrated: c_k o_k, released: o_k phi_k)   (C)
    f(x)       = sum_k p(G_k | x) f_k                                                                          (D)

H(x) is all k with a Mahalanobis distance of x to G_k of at most the cutoff; what that leaves out is a c_k of less than
exp(-cutoff^2 / 2) each, 0.011 at the default of 3. Integrated: all whose bounding box at the cutoff touches V(x); what
that leaves out is less than 6 Phi(-cutoff) of a Gaussian's mass, 0.008. Released: all whose voxel is, along each axis,
at most ceil(cutoff s_max / voxel) voxels away.

Gaussians that are finer than the lattice can show would fall between the voxels' centers. A deviation s_ki below a
given s_min becomes s_min, and phi_k is multiplied by (prod_i s_ki / max(s_ki, s_min))^(2/3), the areas' ratio, so that
what a surface of Gaussians adds up to stays as it is. Such a limit is Mip-Splatting's (Z. Yu et al., CVPR 2024, Sec.
5.1); that its weight goes with the area is due to occupancy, whose Gaussians stand side by side on surfaces.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..core.types import Gaussians
from ..settings.stages import OccupancyOptions as Options
from . import splat_kernels
from .gaussian_bins import INTEGRATED, MODES, POISSON, PROBABILISTIC, RELEASED, Bins, prepare_gaussians, sort_by_block


def check(options: Options) -> None:
    """Raises ConfigError or DependencyError if Gaussians cannot be projected on the device that is asked for."""
    if options.device != "cpu":
        from . import splat_torch

        splat_torch.check_device(options.device)


def bin_gaussians(
    gaussians: Gaussians,
    origin: NDArray[np.float64],
    options: Options,
    shape: tuple[int, int, int] | None = None,
    least_scale: float = 0.0,
) -> Bins:
    """Sort Gaussians into blocks of the lattice whose voxel (0, 0, 0) has its lower corner at ``origin``.

    shape: only the voxels (0, 0, 0) … shape - 1 are evaluated, however far a Gaussian reaches; all by default.
    least_scale: s_min, meters.
    """
    check(options)
    mode = MODES[options.projection]
    scales, share = widen_scales(gaussians.scales, least_scale, options)
    means, form, log_weight, lo, hi = prepare_gaussians(
        gaussians.means, scales, gaussians.quats_wxyz, gaussians.opacities, origin, options.voxel_size,
        options.cutoff, mode,
    )  # fmt: skip
    if shape is not None:
        lo, hi = np.maximum(lo, np.int32(0)), np.minimum(hi, np.array(shape, np.int32) - 1)
    packed, start, gaussian = sort_by_block(lo, hi)
    squared_cutoff = np.float32(np.inf if mode == RELEASED else options.cutoff**2)
    return Bins(
        packed, start, gaussian, means, form, lo, hi, gaussians.opacities, share, log_weight, mode,
        squared_cutoff, options.device,
    )  # fmt: skip


def widen_scales(
    scales: NDArray[np.float32], least_scale: float, options: Options
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """(N, 3) deviations of at least s_min, meters, and the (N,) shares that the phi are multiplied by. A mass within
    a voxel needs no such thing, nor does what is dilated."""
    if least_scale == 0 or MODES[options.projection] not in (PROBABILISTIC, POISSON):
        return scales, np.ones(len(scales), np.float32)
    wide = np.maximum(scales, np.float32(least_scale))
    return wide, np.asarray((scales / wide).prod(axis=1) ** np.float32(2 / 3), np.float32)


def compute_probability(bins: Bins, keys: NDArray[np.int32]) -> NDArray[np.float32]:
    """(B, 512) alpha at every voxel of the bins' blocks, whose (B, 3) keys are given: equations (A) and (B)."""
    if bins.device != "cpu":
        from . import splat_torch

        return splat_torch.compute_probability_torch(bins, keys, bins.mode != PROBABILISTIC)
    listed = keys, bins.start, bins.gaussian, bins.means, bins.form, bins.lo, bins.hi
    if bins.mode == INTEGRATED:
        return splat_kernels.splat_mass(*listed)
    return splat_kernels.splat_probability(
        *listed, bins.opacities, bins.share, bins.squared_cutoff, bins.mode != PROBABILISTIC
    )


def compute_posterior_mean(
    bins: Bins, keys: NDArray[np.int32], slots: NDArray[np.int32], values: NDArray[np.floating]
) -> NDArray[np.float32]:
    """(V, D) posterior expectation of per-Gaussian values (N, D) at some voxels: equations (C) and (D).

    slots: (B, 512) row of the output for each voxel of the bins' blocks, -1 for voxels that are not asked for. A voxel
    without a neighboring Gaussian gets zeros. values: float16 ones are taken as they are, without a copy of all.
    """
    rows = int(slots.max(initial=-1)) + 1
    if bins.device != "cpu":
        from . import splat_torch

        return splat_torch.compute_posterior_mean_torch(bins, keys, slots, values, rows)
    return splat_kernels.splat_posterior_mean(
        keys, bins.start, bins.gaussian, bins.means, bins.form, bins.lo, bins.hi, bins.log_weight, bins.squared_cutoff,
        bins.mode == INTEGRATED, slots, values.view(np.uint16) if values.dtype == np.float16 else values, rows,
    )  # fmt: skip
