"""Gaussian-to-occupancy projection (paper, Sec. "Gaussian-to-Occupancy Projection") over sparse voxel blocks.

Every mode is a product over the neighboring Gaussians H(x) of a voxel with center x and box V(x),

    alpha(x) = 1 - prod_{k in H(x)} (1 - c_k(x)),                                                             (B)

with phi_k(x) = exp(-1/2 (x - mu_k)^T Sigma_k^-1 (x - mu_k)), Sigma_k = R(r_k) diag(s_k^2) R(r_k)^T, and

    probabilistic   c_k = phi_k(x): the paper's; opacity plays no part                                         (A)
    poisson         c_k = 1 - exp(-o_k phi_k(x)), so that alpha = 1 - exp(-sum_k o_k phi_k(x))
    integrated      c_k = 1 - (1 - m_k(x))^a_k, m_k(x) being the mass of N(mu_k, Sigma_k') within V(x), and a_k the area
                    that a Gaussian stands for, over that of a cell of half a voxel's edge. For the default cells, a_k
                    is 1, and c_k the mass; the default
    released        as poisson, with Sigma_k (m^2) in place of Sigma_k^-1: what the paper's code seems to compute. phi
                    is 1 in all of H(x), which amounts to a dilation by H(x); for comparison.

and the features of the voxel are posterior means,

    p(G_k | x) = w_k(x) / sum_j w_j(x),  w_k = N(x; mu_k, Sigma_k) o_k  (integrated: m_k o_k, released: o_k phi_k)   (C)
    f(x)       = sum_k p(G_k | x) f_k                                                                          (D)

H(x) holds every k whose Mahalanobis distance to x does not exceed the cutoff. Each c_k that this omits is less than
exp(-cutoff^2 / 2), 0.011 at the default of 3. Integrated: every k whose bounding box at the cutoff touches V(x). This
omits less than 6 Phi(-cutoff) of a Gaussian's mass, 0.008. Released: every k whose voxel is, along each axis, no more
than ceil(cutoff s_max / voxel) voxels away.

Gaussians that are finer than the lattice would fall between the voxels' centers. So a deviation s_ki below a given
s_min becomes s_min. phi_k is multiplied by the ratio of the areas, (prod_i s_ki / max(s_ki, s_min))^(2/3), so that the
sum over a surface of Gaussians stays the same. The limit comes from Mip-Splatting (Z. Yu et al., CVPR 2024, Sec. 5.1).
The weight follows the area because the Gaussians of occupancy lie next to each other on surfaces. Mass needs no limit:
it is exact at any size.

Gaussians that are rendered overlap widely, lest one sees between them. Sigma' is as narrow along the surface as an even
sheet allows: of Gaussians a spacing apart with a deviation of half a spacing, it is even to 4 exp(-2 pi^2 / 4), 3 %. So
a surface ends in the voxel where it ends. No deviation becomes smaller than the least.

Why mass: a thin disc tells in which voxels a surface lies, however near it is to their faces, while phi at a voxel's
center tells how near the center is to the surface. A surface that runs close to a face is one voxel thick, not two.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..core.errors import FreeOccError
from ..core.types import BLOCK, Gaussians
from ..core.voxel_keys import KEY_LIMIT
from ..settings.stages import OccupancyOptions as Options
from . import splat_kernels
from .gaussian_bins import INTEGRATED, MODES, PROBABILISTIC, RELEASED, Bins, prepare_gaussians, sort_by_block

_MOST_TOUCHED = 1 << 28
"""Pairs of a Gaussian and a block that it touches; a Gaussian of a map touches about ten."""
_SPACED, _EVEN = 0.7, 0.5
"""Deviations along a surface over the spacing of its Gaussians: of rendered ones (``gaussians.coverage``), and of those
whose mass counts."""
_MOST_OF_EACH, _FEW_TOUCHED = 512, 1 << 20
"""Blocks that Gaussians touch on average, at most, and a number of pairs that takes no time."""


def check(options: Options) -> None:
    """Raises ConfigError or DependencyError if the chosen device cannot project Gaussians."""
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
    """Sorts Gaussians into blocks of the lattice whose voxel (0, 0, 0) has its lower corner at ``origin``.

    shape: limits the evaluation to the voxels (0, 0, 0) … shape - 1; all by default.
    least_scale: s_min, meters. Raises FreeOccError if they touch too many blocks, or, without ``shape``, reach farther
    than voxels have keys.
    """
    check(options)
    if shape is None:
        _refuse_far(gaussians, origin, options, least_scale)
    mode = MODES[options.projection]
    scales, share = adapt_scales(gaussians.scales, least_scale, options)
    means, form, log_weight, lo, hi = prepare_gaussians(
        gaussians.means, scales, gaussians.quats_wxyz, gaussians.opacities, origin, options.voxel_size,
        options.cutoff, mode,
    )  # fmt: skip
    if shape is not None:
        lo, hi = np.maximum(lo, np.int32(0)), np.minimum(hi, np.array(shape, np.int32) - 1)
    _refuse_many(lo, hi, options)
    packed, start, gaussian = sort_by_block(lo, hi, options.voxel_size)
    squared_cutoff = np.float32(np.inf if mode == RELEASED else options.cutoff**2)
    return Bins(
        packed, start, gaussian, means, form, lo, hi, gaussians.opacities, share, log_weight, mode,
        squared_cutoff, options.device,
    )  # fmt: skip


def _refuse_far(gaussians: Gaussians, origin: NDArray[np.float64], options: Options, least_scale: float) -> None:
    if not len(gaussians):
        return
    reach = np.abs(gaussians.means - origin).max() + options.cutoff * max(gaussians.scales.max(), least_scale)
    if not reach / options.voxel_size < KEY_LIMIT - BLOCK:
        raise FreeOccError(
            f"Gaussians reach {reach:.3g} m from the origin, too far for voxels of {options.voxel_size:g} m: they are "
            "damaged, or the voxels too small."
        )


def _refuse_many(lo: NDArray[np.int32], hi: NDArray[np.int32], options: Options) -> None:
    touched = np.maximum((hi >> 3).astype(np.float64) - (lo >> 3) + 1, 0).prod(axis=1).sum()
    if touched > min(_MOST_TOUCHED, max(_MOST_OF_EACH * len(lo), _FEW_TOUCHED)):
        raise FreeOccError(
            f"{len(lo)} Gaussians touch {touched:.3g} blocks of voxels of {options.voxel_size:g} m, more than memory "
            "and time suffice for: choose a larger occupancy.voxel_size, or smaller values of occupancy.cutoff, "
            "gaussians.coverage, gaussians.gamma and gaussians.uncertainty."
        )


def adapt_scales(
    scales: NDArray[np.float32], least_scale: float, options: Options
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Returns (N, 3) deviations, meters, as the mode needs them, and (N,) factors: of phi, or a_k."""
    mode = MODES[options.projection]
    if mode == INTEGRATED:
        least, middle, most = np.sort(scales, axis=1).T
        area = middle * most / np.float32(_SPACED * 0.5 * options.voxel_size) ** 2
        return np.maximum(np.float32(_EVEN / _SPACED) * scales, least[:, None]), np.asarray(area, np.float32)
    if least_scale == 0 or mode == RELEASED:
        return scales, np.ones(len(scales), np.float32)
    wide = np.maximum(scales, np.float32(least_scale))
    return wide, np.asarray((scales / wide).prod(axis=1) ** np.float32(2 / 3), np.float32)


def compute_probability(bins: Bins, keys: NDArray[np.int32]) -> NDArray[np.float32]:
    """Returns the (B, 512) alpha of the voxels of the bins' blocks: equations (A), (B). keys: (B, 3) of the blocks."""
    if bins.device != "cpu":
        from . import splat_torch

        return splat_torch.compute_probability_torch(bins, keys)
    listed = keys, bins.start, bins.gaussian, bins.means, bins.form, bins.lo, bins.hi
    if bins.mode == INTEGRATED:
        return splat_kernels.splat_mass(*listed, bins.share)
    return splat_kernels.splat_probability(
        *listed, bins.opacities, bins.share, bins.squared_cutoff, bins.mode != PROBABILISTIC
    )


def compute_posterior_mean(
    bins: Bins, keys: NDArray[np.int32], slots: NDArray[np.int32], values: NDArray[np.floating]
) -> NDArray[np.float32]:
    """Returns the (V, D) posterior means of per-Gaussian values (N, D) at chosen voxels: equations (C) and (D).

    slots: (B, 512) row of the output for each voxel of the bins' blocks, -1 for the other voxels. A voxel without a
    neighboring Gaussian gets zeros.  values: float16 values are used without a float32 copy of the whole.
    """
    rows = int(slots.max(initial=-1)) + 1
    if bins.device != "cpu":
        from . import splat_torch

        return splat_torch.compute_posterior_mean_torch(bins, keys, slots, values, rows)
    return splat_kernels.splat_posterior_mean(
        keys, bins.start, bins.gaussian, bins.means, bins.form, bins.lo, bins.hi, bins.log_weight, bins.squared_cutoff,
        bins.mode == INTEGRATED, slots, values.view(np.uint16) if values.dtype == np.float16 else values, rows,
    )  # fmt: skip
