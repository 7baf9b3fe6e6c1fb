"""Turns voxels of one or several sizes into an octree of OctoMap's shape, pruned and in the order of its files."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

DEPTH = 16
"""Levels below the root: a leaf at full depth is one voxel."""
KEY_ORIGIN = 1 << DEPTH - 1
"""Key of the voxel with its lower corner at the tree's origin."""


@dataclass(frozen=True)
class Leaves:
    """Known cubes of one size.

    corners: (N, 3) lower corners from the tree's origin, in voxels of full depth, multiples of the cubes' edge.
    values: (N,) float32 log-odds.  colors: (N, 3) uint8.
    """

    corners: NDArray[np.int32]
    values: NDArray[np.float32]
    colors: NDArray[np.uint8]

    def __len__(self) -> int:
        return len(self.corners)


@dataclass(frozen=True)
class Octree:
    """All nodes, depth first from the root, with children in the order of their numbers: bit 0 = upper half along x,
    bit 1 along y, bit 2 along z.

    values: (M,) float32 log-odds; an inner node has its children's largest.  colors: (M, 3) uint8; an inner node has
    its children's mean.  children: (M,) uint8, bit i = child i exists, 0 = a leaf.  kinds: (M,) uint16, bits 2 i and
    2 i + 1 describe child i: 0 unknown, 1 free, 2 occupied, 3 with its own children.
    """

    values: NDArray[np.float32]
    colors: NDArray[np.uint8]
    children: NDArray[np.uint8]
    kinds: NDArray[np.uint16]

    def __len__(self) -> int:
        return len(self.values)


@dataclass(frozen=True)
class _Level:
    """Nodes of one depth, sorted by Morton code."""

    codes: NDArray[np.int64]
    values: NDArray[np.float32]
    colors: NDArray[np.uint8]
    children: NDArray[np.uint8]
    kinds: NDArray[np.uint16]

    def taken(self, rows: NDArray[np.generic]) -> _Level:
        return _Level(*(getattr(self, name)[rows] for name in self.__dataclass_fields__))

    @classmethod
    def joined(cls, parts: Sequence[_Level]) -> _Level:
        every = cls(*(np.concatenate([getattr(part, name) for part in parts]) for name in cls.__dataclass_fields__))
        return every.taken(np.argsort(every.codes, kind="stable"))


def build_octree(levels: Sequence[Leaves]) -> Octree:
    """Returns the pruned tree of cubes that do not overlap. Cubes of level n have edges of 2^n voxels. Pruning turns
    eight leaves of one value and color into one leaf of the next size. Corners must lie within the tree, [-KEY_ORIGIN,
    KEY_ORIGIN)."""
    below = _leaves(levels[0] if levels else None, 0)
    kept: list[_Level] = []
    for height in range(DEPTH):
        below, parents = _merged(below)
        kept.append(below)
        own = _leaves(levels[height + 1] if height + 1 < len(levels) else None, height + 1)
        below = _Level.joined([parents, own])
    kept.append(below)
    # Depth first: sorts by a node's first voxel, with the larger node first.
    first = [level.codes << 3 * height for height, level in enumerate(kept)]
    order = np.argsort(
        np.concatenate([codes * (DEPTH + 1) + DEPTH - height for height, codes in enumerate(first)]), kind="stable"
    )
    values, colors, children, kinds = (
        np.concatenate([getattr(level, name) for level in kept])[order]
        for name in ("values", "colors", "children", "kinds")
    )
    return Octree(values, colors, children, kinds)


def _merged(level: _Level) -> tuple[_Level, _Level]:
    """Returns the nodes of a level that stay, and their parents. Eight equal leaves become one leaf, their parent."""
    if not len(level.codes):
        return level, level
    parent = level.codes >> 3
    starts = np.flatnonzero(np.diff(parent, prepend=-1))
    count = np.diff(np.append(starts, len(parent)))
    group = np.repeat(np.arange(len(starts)), count)
    first = starts[group]
    equal = (level.values == level.values[first]) & (level.colors == level.colors[first]).all(axis=1)
    equal &= level.children == 0
    pruned = (count == 8) & np.logical_and.reduceat(equal, starts)

    number = (level.codes & 7).astype(np.uint16)
    kind = np.where(level.children > 0, 3, np.where(level.values > 0, 2, 1)).astype(np.uint16)
    children = np.bitwise_or.reduceat((1 << number).astype(np.uint8), starts)
    kinds = np.bitwise_or.reduceat(kind << 2 * number, starts)
    occupied = (level.values > 0).astype(np.uint32)
    number_of = np.add.reduceat(occupied, starts)[:, None]
    total = np.add.reduceat(level.colors * occupied[:, None], starts, axis=0)
    mean = np.where(number_of > 0, total // np.maximum(number_of, 1), level.colors[starts])
    parents = _Level(
        codes=parent[starts],
        values=np.maximum.reduceat(level.values, starts),
        colors=mean.astype(np.uint8),
        children=np.where(pruned, 0, children).astype(np.uint8),
        kinds=np.where(pruned, 0, kinds).astype(np.uint16),
    )
    return level.taken(~pruned[group]), parents


def _leaves(leaves: Leaves | None, height: int) -> _Level:
    if leaves is None:
        leaves = Leaves(np.zeros((0, 3), np.int32), np.zeros(0, np.float32), np.zeros((0, 3), np.uint8))
    key = (leaves.corners.astype(np.int64) + KEY_ORIGIN) >> height
    codes = _spread(key[:, 0]) | _spread(key[:, 1]) << 1 | _spread(key[:, 2]) << 2
    order = np.argsort(codes)
    none = np.zeros(len(codes), np.uint8)
    return _Level(codes[order], leaves.values[order], leaves.colors[order], none, none.astype(np.uint16))


def _spread(key: NDArray[np.int64]) -> NDArray[np.int64]:
    """Returns the (N,) 16-bit numbers with two zero bits between their bits."""
    x = key & 0xFFFF
    x = (x | x << 16) & 0x0000FF0000FF
    x = (x | x << 8) & 0x00F00F00F00F
    x = (x | x << 4) & 0x0C30C30C30C3
    return (x | x << 2) & 0x249249249249
