"""Maps on another lattice: exact where the lattices agree, without holes where they do not."""

import numpy as np
import pytest
from scenes import occupancy_of
from scipy import ndimage

from freeocc3d.core.transforms import quats_to_rotations, transform
from freeocc3d.core.types import FREE, OCCUPIED
from freeocc3d.occupancy.resampling import resample_occupancy


def rigid(quat, t=(0, 0, 0)):
    T = np.eye(4)
    T[:3, :3] = quats_to_rotations(np.asarray(quat, float) / np.linalg.norm(quat))
    T[:3, 3] = t
    return T


def test_a_quarter_turn_and_whole_voxels_move_every_voxel_as_it_is() -> None:
    rng = np.random.default_rng(0)
    voxels = np.unique(rng.integers(-20, 20, (300, 3)), axis=0)
    colors = rng.integers(0, 256, (200, 3))
    old = occupancy_of(voxels[:200], colors=colors, free=voxels[200:], origin=(0.5, -0.2, 0.1))
    T = rigid((1, 0, 0, 1), (0.3, -0.4, 1.0))
    new, rows = resample_occupancy(old, T, np.array((0.0, 0.0, 0.1)))
    for state in (OCCUPIED, FREE):
        expected = transform(T, old.centers(old.voxels(state)))
        found = new.centers(new.voxels(state))
        np.testing.assert_allclose(sorted(found.tolist()), sorted(np.round(expected, 9).tolist()), atol=1e-6)
    np.testing.assert_array_equal(new.colors, old.colors[rows])
    np.testing.assert_allclose(
        new.centers(new.occupied_voxels()), transform(T, old.centers(old.occupied_voxels()))[rows], atol=1e-6
    )


@pytest.mark.parametrize("seed", range(3))
def test_a_wall_has_no_holes_and_moves_less_than_a_voxel(seed) -> None:
    i, j = np.mgrid[:30, :30]
    wall = np.stack((i, j, 0 * i), axis=-1).reshape(-1, 3)
    sides = np.concatenate([wall + (0, 0, z) for z in (-3, -2, -1, 1, 2, 3)])
    old = occupancy_of(wall, free=sides)
    T = rigid(np.random.default_rng(seed).normal(size=4), (0.01, 0.02, 0.03))
    new, _ = resample_occupancy(old, T, np.zeros(3))
    occupied, free = new.occupied_voxels(), new.voxels(FREE)
    # Nothing gets through: free space on both sides is not connected by faces within the slab.
    low = np.minimum(occupied.min(axis=0), free.min(axis=0))
    grid = np.zeros(np.maximum(occupied.max(axis=0), free.max(axis=0)) - low + 1, bool)
    grid[tuple((free - low).T)] = True
    parts, _ = ndimage.label(grid)
    at_old = transform(np.linalg.inv(T), new.centers(free))
    inner = (at_old[:, :2] > 0.3).all(axis=1) & (at_old[:, :2] < 2.7).all(axis=1)
    number = parts[tuple((free[inner] - low).T)]
    assert not set(number[at_old[inner, 2] < 0]) & set(number[at_old[inner, 2] > 0.1])
    height = transform(np.linalg.inv(T), new.centers(occupied))[:, 2] - 0.05
    assert np.abs(height).max() <= 0.1 * np.sqrt(3) / 2 + 1e-6


def test_an_empty_map_stays_empty() -> None:
    new, rows = resample_occupancy(occupancy_of([]), np.eye(4), np.zeros(3))
    assert len(new.keys) == len(rows) == 0
