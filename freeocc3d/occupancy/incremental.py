"""Keeps layer 4 current while keyframes come, go and move: it rebuilds only the blocks that they touch."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..core.types import OCCUPIED, Frame, Gaussians, Occupancy
from ..core.voxel_keys import pack_voxels, unpack_voxels
from . import build, carve, splat
from .levels import mask_known_blocks, select_blocks
from .voxel_blocks import unite_keys


@dataclass(frozen=True)
class _Kept:
    """What a keyframe brought. touched: packed keys of the blocks that its Gaussians reach."""

    gaussians: Gaussians
    features: NDArray[np.float16]
    T_world_cam: NDArray[np.float64]
    touched: NDArray[np.int64]


class IncrementalOccupancy:
    """The occupancy of a set of keyframes, each with the Gaussians that are anchored to it.

    ``update()`` returns, to the last bit, what ``build_occupancy`` returns for the same set with the Gaussians in the
    order of the keyframes' numbers, but without blocks of which nothing is known. It rebuilds the blocks that the
    keyframes touch which were added, removed or moved since the last update, and copies the others.
    """

    def __init__(
        self, splatting: splat.Options, carving: carve.Options, origin: NDArray[np.float64] | None = None
    ) -> None:
        self.splatting, self.carving = splatting, carving
        self.evidence = carve.DepthEvidence(np.zeros(3) if origin is None else origin, splatting.voxel_size, carving)
        self.stale = np.zeros(0, np.int64)
        """Packed keys of the blocks that the next update rebuilds."""
        self._keyframes: dict[int, _Kept] = {}
        self._none: tuple[Gaussians, NDArray[np.float16]] | None = (
            None  # no Gaussians, and no features of the same size
        )
        self._now: Occupancy | None = None

    def add(
        self,
        number: int,
        frame: Frame,
        T_world_cam: NDArray[np.float64],
        gaussians: Gaussians,
        features: NDArray[np.float16],
    ) -> None:
        """Adds a keyframe under its own number, with its N Gaussians and their features (N, D)."""
        if number in self._keyframes:
            raise ValueError(f"keyframe {number} was already added")
        touched = splat.bin_gaussians(gaussians, self.evidence.origin, self.splatting).packed
        self._keyframes[number] = _Kept(gaussians, features, T_world_cam, touched)
        self._none = gaussians[:0], features[:0]
        self.stale = unite_keys(self.stale, touched, self.evidence.add(frame, T_world_cam))

    def remove(self, number: int, frame: Frame) -> None:
        """Removes a keyframe; ``frame`` is the frame that was added. Raises KeyError for an unknown number."""
        kept = self._keyframes.pop(number)
        self.stale = unite_keys(self.stale, kept.touched, self.evidence.remove(frame, kept.T_world_cam))

    def move(self, number: int, frame: Frame, T_world_cam: NDArray[np.float64], gaussians: Gaussians) -> None:
        """Moves a keyframe to another pose. gaussians: its Gaussians after ``anchors.reanchor`` moved them."""
        features = self._keyframes[number].features
        self.remove(number, frame)
        self.add(number, frame, T_world_cam, gaussians, features)

    def update(self) -> Occupancy:
        """Returns the occupancy of the current keyframes. Raises ValueError before the first keyframe."""
        stale = self.stale
        reaching = [
            self._keyframes[number]
            for number in sorted(self._keyframes)
            if np.isin(self._keyframes[number].touched, stale, assume_unique=True).any()
        ]
        if self._none is None:  # nothing was ever added
            raise ValueError("add a keyframe before the first update")
        gaussians = Gaussians.concatenated([self._none[0], *(kept.gaussians for kept in reaching)])
        features = np.concatenate([self._none[1], *(kept.features for kept in reaching)])
        bins = splat.bin_gaussians(gaussians, self.evidence.origin, self.splatting).only(stale)
        made = build.build_blocks(stale, bins, gaussians, features, self.evidence, self.splatting, self.carving)
        self._now = _merged(self._now, made)
        self.stale = np.zeros(0, np.int64)
        return self._now


def _merged(old: Occupancy | None, new: Occupancy) -> Occupancy:
    """Returns the new blocks in place of the old ones of the same keys, without blocks of which nothing is known; keys
    ascend."""
    parts = [new] if old is None else [select_blocks(old, ~np.isin(pack_voxels(old.keys), pack_voxels(new.keys))), new]
    parts = [select_blocks(part, mask_known_blocks(part)) for part in parts]
    packed = np.concatenate([pack_voxels(part.keys) for part in parts])
    order = np.argsort(packed)
    arrays = {
        name: np.concatenate([getattr(part, name) for part in parts])[order]
        for name in ("probability", "free", "hits", "state", "levels")
    }
    count = np.concatenate([np.count_nonzero(part.state == OCCUPIED, axis=1) for part in parts])
    first = np.cumsum(count) - count
    rows = np.repeat(first[order] - (np.cumsum(count[order]) - count[order]), count[order]) + np.arange(count.sum())
    return new.replace(
        keys=unpack_voxels(packed[order]),
        features=np.concatenate([part.features for part in parts])[rows],
        colors=np.concatenate([part.colors for part in parts])[rows],
        **arrays,
    )
