"""Maps of several voxel sizes: combines maps of one size each, and brings a map to one size."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..core.types import BLOCK, FREE, OCCUPIED, UNKNOWN, Occupancy
from ..core.voxel_keys import pack_voxels, unpack_voxels
from .build import normalize_rows

PER_BLOCK = "keys", "probability", "free", "hits", "state"
"""Arrays of an ``Occupancy`` with a row for each block."""

_OCTANTS = np.stack(np.unravel_index(np.arange(8), (2, 2, 2)), axis=1)
"""(8, 3) places of the eight parts of a block."""


def subdivide_keys(keys: NDArray[np.integer]) -> NDArray[np.int32]:
    """Returns the (8 B, 3) keys of the next level's blocks that cover (B, 3) blocks, eight in a row for each."""
    return np.asarray((2 * keys[:, None] + _OCTANTS).reshape(-1, 3), np.int32)


def combine_levels(parts: Sequence[Occupancy]) -> Occupancy:
    """Returns one map of all parts. Blocks must not overlap; part n has 1 / 2^n of the first part's voxel size."""
    first = parts[0]
    return first.replace(
        levels=np.concatenate([np.full(len(part.keys), level, np.uint8) for level, part in enumerate(parts)]),
        features=np.concatenate([np.asarray(part.features) for part in parts]),
        colors=np.concatenate([part.colors for part in parts]),
        **{name: np.concatenate([getattr(part, name) for part in parts]) for name in PER_BLOCK},
    )


def select_blocks(occupancy: Occupancy, chosen: NDArray[np.bool_]) -> Occupancy:
    """Returns the blocks of a mask (B,)."""
    kept = chosen[np.nonzero(occupancy.state == OCCUPIED)[0]]
    return occupancy.replace(
        features=occupancy.features[kept],
        colors=occupancy.colors[kept],
        levels=occupancy.levels[chosen],
        **{name: getattr(occupancy, name)[chosen] for name in PER_BLOCK},
    )


def mask_known_blocks(occupancy: Occupancy) -> NDArray[np.bool_]:
    """Returns (B,) whether a block has a known voxel."""
    known = (occupancy.probability > 0) | (occupancy.free > 0) | (occupancy.hits > 0)
    return np.asarray(known.any(axis=1))


def make_uniform(occupancy: Occupancy, level: int = 0) -> Occupancy:
    """Returns the map with voxels of one size, ``voxel_size / 2^level``.

    Larger voxels are cut; each part has the values of the whole. Eight smaller voxels are merged into one. It is
    occupied if any part is, else unknown if any part is, else free. It has the highest probability, the most evidence,
    and the mean color and feature of its occupied parts. Features are decoded.
    """
    current = occupancy
    if not (current.levels != level).any():
        return current.replace(voxel_size=occupancy.voxel_size / 2**level, levels=np.zeros_like(current.levels))
    rows = np.full(current.state.shape, -1, np.int64)  # each occupied voxel's row in features and colors
    rows[current.state == OCCUPIED] = np.arange(np.count_nonzero(current.state == OCCUPIED))
    arrays = {name: getattr(current, name) for name in PER_BLOCK if name != "keys"} | {"rows": rows}
    keys, levels = current.keys, current.levels.astype(int)
    while (levels < level).any():
        coarse = levels < level
        cut = {name: np.concatenate((array[~coarse], _cut(array[coarse]))) for name, array in arrays.items()}
        keys = np.concatenate((keys[~coarse], subdivide_keys(keys[coarse])))
        levels = np.concatenate((levels[~coarse], np.repeat(levels[coarse] + 1, 8)))
        arrays = cut
    features, colors = np.asarray(current.features), current.colors
    while (levels > level).any():
        deep = levels == levels.max()
        parents, blocks, features, colors = _joined(
            keys[deep], {name: array[deep] for name, array in arrays.items()}, features, colors
        )
        arrays = {name: np.concatenate((array[~deep], blocks[name])) for name, array in arrays.items()}
        keys = np.concatenate((keys[~deep], parents))
        levels = np.concatenate((levels[~deep], np.full(len(parents), levels.max() - 1)))
    order = np.argsort(pack_voxels(keys))
    at = arrays.pop("rows")[order]
    at = at[arrays["state"][order] == OCCUPIED]
    return Occupancy(
        voxel_size=occupancy.voxel_size / 2**level,
        origin=occupancy.origin,
        keys=keys[order],
        features=features[at],
        colors=colors[at],
        **{name: array[order] for name, array in arrays.items()},
    )


def _cut(blocks: NDArray[np.generic]) -> NDArray[np.generic]:
    """Returns the next level's (8 B, 512) values for (B, 512) values, in the order of ``subdivide_keys``."""
    half = BLOCK // 2
    parts = blocks.reshape(-1, 2, half, 2, half, 2, half).transpose(0, 1, 3, 5, 2, 4, 6).reshape(-1, half, half, half)
    for axis in (1, 2, 3):
        parts = np.repeat(parts, 2, axis=axis)
    return np.asarray(parts.reshape(-1, BLOCK**3))


def _joined(
    keys: NDArray[np.int32],
    arrays: dict[str, NDArray[np.generic]],
    features: NDArray[np.float16],
    colors: NDArray[np.uint8],
) -> tuple[NDArray[np.int32], dict[str, NDArray[np.generic]], NDArray[np.float16], NDArray[np.uint8]]:
    """Merges blocks into blocks of the level before. Returns their keys and arrays, and features and colors with added
    rows for the new voxels. Where a sibling of a block is missing, nothing is known."""
    parents, row = np.unique(pack_voxels(keys >> 1), return_inverse=True)
    octant = (keys & 1) @ np.array((4, 2, 1))
    half = BLOCK // 2

    def gathered(name: str, missing: int) -> NDArray[np.generic]:
        """Returns (B', 8, 64, 8): for each eighth of each parent, the eight parts of its 4 x 4 x 4 voxels."""
        values = arrays[name]
        parts = values.reshape(-1, half, 2, half, 2, half, 2).transpose(0, 1, 3, 5, 2, 4, 6).reshape(-1, half**3, 8)
        out = np.full((len(parents), 8, half**3, 8), missing, values.dtype)
        out[row, octant] = parts
        return out

    def placed(values: NDArray[np.generic]) -> NDArray[np.generic]:
        """Returns (B', 8, 64) values of voxels as (B', 512) in storage order."""
        grid = values.reshape(-1, 2, 2, 2, half, half, half).transpose(0, 1, 4, 2, 5, 3, 6)
        return np.asarray(grid.reshape(-1, BLOCK**3))

    state = gathered("state", UNKNOWN)
    occupied, unknown = state == OCCUPIED, state == UNKNOWN
    joined = np.where(unknown.any(axis=3), UNKNOWN, FREE).astype(np.uint8)
    joined[occupied.any(axis=3)] = OCCUPIED
    made: dict[str, NDArray[np.generic]] = {
        name: placed(gathered(name, 0).max(axis=3)) for name in ("probability", "free", "hits")
    }
    voxel = np.nonzero(occupied.reshape(-1, 8).any(axis=1))[0]
    part_voxel, part = np.nonzero(occupied.reshape(-1, 8))
    part_row = gathered("rows", -1).reshape(-1, 8)[part_voxel, part].astype(np.int64)
    number = np.searchsorted(voxel, part_voxel)
    starts = np.searchsorted(number, np.arange(len(voxel)))
    count = np.diff(np.append(starts, len(number)))[:, None]
    rows = np.full(joined.size, -1, np.int64)
    rows[voxel] = len(colors) + np.arange(len(voxel))
    if len(voxel):
        mean_color = np.add.reduceat(colors[part_row].astype(np.float32), starts, axis=0) / count
        mean_feature = np.add.reduceat(features[part_row].astype(np.float32), starts, axis=0)
        colors = np.concatenate((colors, np.rint(mean_color).astype(np.uint8)))
        features = np.concatenate((features, normalize_rows(mean_feature)))
    made |= {"state": placed(joined), "rows": placed(rows.reshape(joined.shape))}
    return unpack_voxels(parents), made, features, colors
