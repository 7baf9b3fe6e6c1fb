"""Packed keys and the block table."""

import numpy as np

from freeocc3d.core import hash_table, voxel_keys
from freeocc3d.occupancy import voxel_blocks


def test_pack_keeps_every_index_and_its_order() -> None:
    rng = np.random.default_rng(0)
    keys = rng.integers(-(1 << 20), 1 << 20, (1000, 3)).astype(np.int32)
    packed = voxel_keys.pack_voxels(keys)
    np.testing.assert_array_equal(voxel_keys.unpack_voxels(packed), keys)
    np.testing.assert_array_equal(np.argsort(packed, kind="stable"), np.lexsort(keys.T[::-1]))


def test_packed_key_is_pack_of_one() -> None:
    keys = np.array([[0, 0, 0], [-5, 7, 1234], [1 << 19, -(1 << 19), -1]], np.int32)
    assert [hash_table.packed_key(*key) for key in keys.tolist()] == voxel_keys.pack_voxels(keys).tolist()


def test_table_finds_what_is_there_and_nothing_else() -> None:
    packed = np.unique(voxel_keys.pack_voxels(np.random.default_rng(1).integers(-50, 50, (5000, 3))))
    table, rows = hash_table.build_table(packed, len(packed))
    assert [hash_table.find_row(table, rows, key) for key in packed.tolist()] == list(range(len(packed)))
    absent = voxel_keys.pack_voxels(np.array([[60, 0, 0], [0, -51, 3]]))
    assert [hash_table.find_row(table, rows, key) for key in absent.tolist()] == [-1, -1]


def test_touched_blocks_of_boxes_are_those_that_a_plain_loop_lists() -> None:
    rng = np.random.default_rng(2)
    lo = rng.integers(-40, 40, (500, 3)).astype(np.int32)
    hi = (lo + rng.integers(-1, 12, (500, 3))).astype(np.int32)  # some are empty
    expected = set()
    for a, b in zip(lo.tolist(), hi.tolist(), strict=True):
        if all(x <= y for x, y in zip(a, b, strict=True)):
            ranges = [range(x >> 3, (y >> 3) + 1) for x, y in zip(a, b, strict=True)]
            expected |= {(i, j, k) for i in ranges[0] for j in ranges[1] for k in ranges[2]}
    found = voxel_keys.unpack_voxels(voxel_blocks.find_touched_blocks(lo, hi))
    assert len(found) == len(expected)
    assert {tuple(key) for key in found.tolist()} == expected


def test_blocks_along_a_ray_connect_the_camera_with_the_surface() -> None:
    keys = voxel_keys.unpack_voxels(
        voxel_blocks.find_blocks_along_rays(np.array([[3.0, 0.1, 0.1]]), np.array([0.1, 0.1, 0.1]), np.zeros(3), 0.08)
    )
    assert sorted(map(tuple, keys.tolist())) == [(i, 0, 0) for i in range(5)]


def test_blocks_along_rays_are_those_that_a_fine_walk_meets() -> None:
    rng = np.random.default_rng(3)
    points, center, origin = rng.uniform(-4, 4, (60, 3)), np.array([0.13, -0.2, 0.37]), np.array([-0.3, 0.1, 0.2])
    points[:20, rng.integers(0, 3, 20)] = center[0]  # some run along an axis
    found = voxel_blocks.find_blocks_along_rays(points, center, origin, 0.05)
    assert (np.diff(found) > 0).all()
    samples = center + (points - center)[:, None] * np.linspace(0, 1, 20_001)[None, :, None]
    met = np.unique(voxel_keys.pack_voxels(np.floor((samples.reshape(-1, 3) - origin) / 0.4).astype(int)))
    assert set(met.tolist()) <= set(found.tolist())
    assert len(found) <= 1.01 * len(met)  # corners that the walk steps over
