"""Layer 4 as a whole: turns anchored Gaussians and depth images into classified voxels with features."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np
from numpy.typing import NDArray

from ..core.types import BLOCK, FREE, OCCUPIED, UNKNOWN, Gaussians, Occupancy, PosedFrame
from ..core.voxel_keys import pack_voxels, unpack_voxels
from . import carve, splat
from .voxel_blocks import unite_keys


def build_occupancy(
    gaussians: Gaussians,
    features: NDArray[np.float16],
    frames: Iterable[PosedFrame],
    splatting: splat.Options,
    carving: carve.Options,
    origin: NDArray[np.float64] | None = None,
    blocks: tuple[int, int, int] | None = None,
    progress: Callable[[int], None] = lambda done: None,
    least_scale: float = 0.0,
) -> Occupancy:
    """Returns the occupancy map of N Gaussians with features (N, D) and of depth images.

    origin: (3,) lower corner of voxel (0, 0, 0); the world's origin by default.  blocks: the map has exactly the blocks
    (0, 0, 0) … blocks - 1; by default it has the blocks that something touches.  progress: takes the number of frames
    done.  least_scale: meters; finer Gaussians are widened to this scale.
    """
    origin = np.zeros(3) if origin is None else np.asarray(origin, np.float64)
    size = splatting.voxel_size
    shape, within = None, None
    if blocks is not None:
        shape = (BLOCK * blocks[0], BLOCK * blocks[1], BLOCK * blocks[2])
        within = pack_voxels(np.stack(np.unravel_index(np.arange(np.prod(blocks)), blocks), axis=1))
    bins = splat.bin_gaussians(gaussians, origin, splatting, shape, least_scale)

    evidence = carve.DepthEvidence(origin, size, carving, within)
    for done, posed in enumerate(frames, start=1):
        evidence.add(posed.frame, posed.T_world_cam)
        progress(done)
    return build_blocks(
        unite_keys(bins.packed, evidence.packed), bins, gaussians, features, evidence, splatting, carving
    )


def build_blocks(
    packed: NDArray[np.int64],
    bins: splat.Bins,
    gaussians: Gaussians,
    features: NDArray[np.float16],
    evidence: carve.DepthEvidence,
    splatting: splat.Options,
    carving: carve.Options,
) -> Occupancy:
    """Returns the occupancy of some blocks. packed: their ascending keys, which include all keys of the bins."""
    free, hits = evidence.at(packed)
    probability = np.zeros((len(packed), BLOCK**3), np.float32)
    splatted = np.searchsorted(packed, bins.packed)
    probability[splatted] = splat.compute_probability(bins, unpack_voxels(bins.packed))
    state = classify(probability, free, hits, splatting, carving)

    slots = np.full(state.shape, -1, np.int32)
    occupied = state == OCCUPIED
    slots[occupied] = np.arange(np.count_nonzero(occupied))
    values = np.concatenate((gaussians.colors.astype(np.float16), features), axis=1)  # 0…255 are exact
    means = splat.compute_posterior_mean(bins, unpack_voxels(bins.packed), slots[splatted], values)
    return Occupancy(
        voxel_size=splatting.voxel_size,
        origin=evidence.origin,
        keys=unpack_voxels(packed),
        probability=probability,
        free=free,
        hits=hits,
        state=state,
        features=normalize_rows(means[:, 3:]),
        colors=np.rint(means[:, :3]).astype(np.uint8),
    )


def compute_features(
    occupancy: Occupancy, gaussians: Gaussians, features: NDArray[np.float16], splatting: splat.Options, scale: float
) -> NDArray[np.float16]:
    """Returns (V, D) features of the V occupied voxels of a map of one voxel size, as ``build_blocks`` computes them.
    features: (N, D) of the Gaussians.  scale: meters; finer Gaussians are widened to it."""
    packed = pack_voxels(occupancy.keys)
    slots = np.full(occupancy.state.shape, -1, np.int32)
    slots[occupancy.state == OCCUPIED] = np.arange(len(occupancy.colors))
    order = np.argsort(packed)
    bins = splat.bin_gaussians(gaussians, occupancy.origin, splatting, None, scale).only(packed[order])
    rows = order[np.searchsorted(packed[order], bins.packed)]
    means = splat.compute_posterior_mean(bins, unpack_voxels(bins.packed), slots[rows], features)
    whole = np.zeros((len(occupancy.colors), features.shape[1]), np.float32)
    whole[: len(means)] = means  # the last voxels may have no Gaussian near them
    return normalize_rows(whole)


def classify(
    probability: NDArray[np.float32],
    free: NDArray[np.uint16],
    hits: NDArray[np.uint16],
    splatting: splat.Options,
    carving: carve.Options,
) -> NDArray[np.uint8]:
    """Returns the state of each voxel: occupied where alpha reaches the threshold and the log-odds of the depth images
    do not contradict it, else free where enough images saw through, else unknown. Unknown never counts as free."""
    contradicted = carve.compute_log_odds(free, hits, carving) <= -splatting.contradiction
    occupied = (probability >= splatting.threshold) & ~contradicted
    state = np.where(free >= carving.min_free, FREE, UNKNOWN).astype(np.uint8)
    state[occupied] = OCCUPIED
    return state


def normalize_rows(features: NDArray[np.float32]) -> NDArray[np.float16]:
    """Returns (V, D) rows scaled to unit length. Zero rows mean "nothing known" and stay zero."""
    norms = np.linalg.norm(features, axis=1, keepdims=True)
    return (features / np.where(norms > 1e-6, norms, 1.0)).astype(np.float16)
