"""The projection in torch, for a GPU: sums over all pairs of a Gaussian and a voxel of its neighborhood.

Products become sums of logarithms, in an order that the device chooses. So results equal those of ``splat`` up to
rounding.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..core.errors import ConfigError, DependencyError
from ..core.types import BLOCK
from ..core.voxel_keys import pack_index, pack_voxels
from .gaussian_bins import INTEGRATED, PROBABILISTIC, Bins
from .gaussian_mass import POINTS, count_points_of_all

_PAIRS = 1 << 24  # per step: 60 bytes each
_LEAST = 1e-9
"""Squared voxels, added to variances: rounding may make a flat Gaussian's negative."""


def check_device(device: str) -> None:
    """Raises ConfigError or DependencyError for a device that torch cannot use."""
    try:
        kind = torch.device(device).type
    except RuntimeError as error:
        raise ConfigError(f"'device' must be cpu or cuda:0, got '{device}'.") from error
    if kind == "cuda" and not torch.cuda.is_available():
        raise DependencyError(f"occupancy.device={device} needs a GPU and a torch build for it; torch finds none.")


def compute_probability_torch(bins: Bins, keys: NDArray[np.int32]) -> NDArray[np.float32]:
    """Does what ``splat.compute_probability`` does."""
    device = torch.device(bins.device)
    logarithms = torch.zeros(len(keys) * BLOCK**3, dtype=torch.float32, device=device)
    opacities, share = (torch.from_numpy(array).to(device) for array in (bins.opacities, bins.share))
    for gaussian, voxel, amount in _pairs(bins, keys, device):
        if bins.mode == INTEGRATED:
            left = share[gaussian] * torch.log1p(-amount)
        else:
            phi = share[gaussian] * torch.exp(-0.5 * amount)
            left = torch.log1p(-phi) if bins.mode == PROBABILISTIC else -opacities[gaussian] * phi  # (A)
        logarithms.index_add_(0, voxel, left)
    return (-torch.expm1(logarithms)).reshape(-1, BLOCK**3).cpu().numpy()  # (B)


def compute_posterior_mean_torch(
    bins: Bins, keys: NDArray[np.int32], slots: NDArray[np.int32], values: NDArray[np.floating], rows: int
) -> NDArray[np.float32]:
    """Does what ``splat.compute_posterior_mean`` does."""
    device = torch.device(bins.device)
    row_of_voxel = torch.from_numpy(slots.reshape(-1).astype(np.int64)).to(device)
    log_weight = torch.from_numpy(bins.log_weight).to(device)
    own = torch.from_numpy(np.ascontiguousarray(values, np.float32)).to(device)
    largest = torch.full((rows,), -torch.inf, device=device)  # each voxel's unit of weights
    for gaussian, voxel, amount in _pairs(bins, keys, device):
        row = row_of_voxel[voxel]
        kept = row >= 0
        exponents = (log_weight[gaussian] + _logarithm(bins, amount))[kept]
        largest.scatter_reduce_(0, row[kept], exponents, "amax")
    mean = torch.zeros((rows, values.shape[1]), device=device)
    total = torch.zeros(rows, device=device)
    for gaussian, voxel, amount in _pairs(bins, keys, device, _PAIRS // max(1, values.shape[1] // 16)):
        row = row_of_voxel[voxel]
        kept = row >= 0
        row, g = row[kept], gaussian[kept]
        weight = torch.exp(log_weight[g] + _logarithm(bins, amount[kept]) - largest[row])  # (C), numerator
        total.index_add_(0, row, weight)
        mean.index_add_(0, row, weight[:, None] * own[g])  # (D)
    return (mean / torch.where(total > 0, total, 1.0)[:, None]).cpu().numpy()  # (C), denominator


def _logarithm(bins: Bins, amount: Tensor) -> Tensor:
    """The part of log w_k that differs between voxels. amount: as ``_pairs`` yields it."""
    return torch.log(amount) if bins.mode == INTEGRATED else -0.5 * amount


def _pairs(
    bins: Bins, keys: NDArray[np.int32], device: torch.device, at_once: int = _PAIRS
) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
    """Yields Gaussian, voxel (block's row * 512 + local index), and squared distance within the cutoff or, integrated,
    mass, of pairs."""
    packed = pack_voxels(keys)
    order = np.argsort(packed)
    sorted_keys = torch.from_numpy(packed[order]).to(device)
    block_row = torch.from_numpy(order).to(device)
    measured = _masses(bins, device, at_once) if bins.mode == INTEGRATED else _distances(bins, device, at_once)
    for g, voxel, amount in measured:
        key = pack_index(*(voxel >> 3).unbind(1))
        at = torch.searchsorted(sorted_keys, key).clamp(max=max(len(sorted_keys) - 1, 0))
        kept = sorted_keys[at] == key
        inside = voxel[kept] & 7
        index = block_row[at[kept]] * BLOCK**3 + (inside[:, 0] * BLOCK + inside[:, 1]) * BLOCK + inside[:, 2]
        yield g[kept], index, amount[kept]


def _masses(bins: Bins, device: torch.device, at_once: int) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
    """Yields Gaussian, voxel (P, 3) and mass: the share of the Gaussian's points in the voxel."""
    count = np.where((bins.lo > bins.hi).any(axis=1), 0, count_points_of_all(bins.lo, bins.hi))
    ends, number = np.cumsum(count), len(count)
    lo, hi = (torch.from_numpy(array.astype(np.int64)).to(device) for array in (bins.lo, bins.hi))
    means, points = torch.from_numpy(bins.means).to(device).double(), torch.from_numpy(POINTS).to(device)
    roots = torch.linalg.cholesky_ex(_symmetric(bins, device))[0]
    first = 0
    while first < number:
        end = max(int(np.searchsorted(ends, (ends[first - 1] if first else 0) + at_once, side="right")), first + 1)
        part = torch.from_numpy(count[first:end]).to(device)
        g = torch.repeat_interleave(torch.arange(first, end, device=device), part)
        n = torch.arange(len(g), device=device) - torch.repeat_interleave(torch.cumsum(part, 0) - part, part)
        voxel = torch.floor(means[g] + (roots[g] @ points[n][:, :, None])[:, :, 0]).long()
        near = ((voxel >= lo[g]) & (voxel <= hi[g])).all(dim=1)
        offset, size = voxel - lo[g], hi[g] - lo[g] + 1
        local = (offset[:, 0] * size[:, 1] + offset[:, 1]) * size[:, 2] + offset[:, 2]
        most = int(size.prod(dim=1).max()) if len(size) else 1
        pair, hits = torch.unique(g[near] * most + local[near], return_counts=True)
        own, local = pair // most, pair % most
        size = hi[own] - lo[own] + 1
        place = (local // (size[:, 1] * size[:, 2]), local // size[:, 2] % size[:, 1], local % size[:, 2])
        mass = (hits / part[own - first]).float()
        yield own, lo[own] + torch.stack(place, dim=1), mass
        first = end


def _symmetric(bins: Bins, device: torch.device) -> Tensor:
    """(N, 3, 3) float64 matrices of the bins' forms, with enough variance for Cholesky's factor."""
    form = torch.from_numpy(bins.form).to(device).double()
    return form[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3) + _LEAST * torch.eye(3, device=device).double()


def _distances(bins: Bins, device: torch.device, at_once: int) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
    """Yields Gaussian, voxel (P, 3) and squared distance of the pairs within the cutoff."""
    lo, hi = (torch.from_numpy(array.astype(np.int64)).to(device) for array in (bins.lo, bins.hi))
    means, form = torch.from_numpy(bins.means).to(device), torch.from_numpy(bins.form).to(device)
    size = (hi - lo + 1).clamp(min=0)
    ends = torch.cumsum(size.prod(dim=1), 0)
    first, pairs = 0, int(ends[-1]) if len(ends) else 0
    while first < pairs:
        number = torch.arange(first, min(first + max(at_once, 1), pairs), device=device)
        first += len(number)
        g = torch.searchsorted(ends, number, right=True)
        local = number - (ends[g] - size[g].prod(dim=1))
        k = local % size[g, 2]
        j = local // size[g, 2] % size[g, 1]
        i = local // (size[g, 2] * size[g, 1])
        voxel = lo[g] + torch.stack((i, j, k), dim=1)
        d = voxel.float() + 0.5 - means[g]
        f = form[g]
        squared = (
            d[:, 0] * (f[:, 0] * d[:, 0] + 2 * f[:, 1] * d[:, 1] + 2 * f[:, 2] * d[:, 2])
            + d[:, 1] * (f[:, 3] * d[:, 1] + 2 * f[:, 4] * d[:, 2])
            + f[:, 5] * d[:, 2] ** 2
        )
        kept = squared <= float(bins.squared_cutoff)
        yield g[kept], voxel[kept], squared[kept]
