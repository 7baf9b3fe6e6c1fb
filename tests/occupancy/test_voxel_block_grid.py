"""Occupancy as Open3D's VoxelBlockGrid, read back, and placed where Open3D itself places it."""

from dataclasses import replace

import numpy as np
import open3d as o3d
import open3d.core as o3c
import pytest
from scenes import lifted, posed, wall_frame

from freeocc3d.core.errors import FreeOccError
from freeocc3d.core.types import OCCUPIED, Occupancy
from freeocc3d.core.voxel_keys import pack_voxels
from freeocc3d.occupancy import build, carve, splat
from freeocc3d.occupancy.voxel_block_grid import from_voxel_block_grid, to_voxel_block_grid


@pytest.fixture(scope="module")
def wall() -> Occupancy:
    frames, poses = [wall_frame(2.0)], [np.eye(4)]
    g = lifted(frames, poses)
    features = np.random.default_rng(0).uniform(0.1, 1, (len(g), 5)).astype(np.float16)
    origin = np.array([0.5, -3.0, 0.01])
    return build.build_occupancy(g, features, posed(frames, poses), splat.Options(), carve.Options(), origin)


def assert_same(a: Occupancy, b: Occupancy) -> None:
    for name in ("keys", "probability", "free", "hits", "state", "colors", "features", "origin"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name), err_msg=name)


def test_there_and_back_nothing_is_lost(wall: Occupancy, tmp_path) -> None:
    grid = to_voxel_block_grid(wall)
    assert_same(from_voxel_block_grid(grid, wall.voxel_size, wall.origin), wall)
    grid.save(str(tmp_path / "grid.npz"))
    read = o3d.t.geometry.VoxelBlockGrid.load(str(tmp_path / "grid.npz"))
    assert_same(from_voxel_block_grid(read, wall.voxel_size, wall.origin), wall)


def test_open3d_places_voxels_where_they_are(wall: Occupancy) -> None:
    grid = to_voxel_block_grid(wall, features=False)
    coordinates, index = grid.voxel_coordinates_and_flattened_indices()
    state = grid.attribute("state").reshape((-1,)).numpy()[index.numpy()]
    theirs = coordinates.numpy()[state == OCCUPIED] + wall.origin + 0.5 * wall.voxel_size
    ours = wall.centers(wall.occupied_voxels())
    assert len(theirs) == len(ours) > 100
    np.testing.assert_allclose(theirs[np.lexsort(theirs.round(3).T)], ours[np.lexsort(ours.round(3).T)], atol=1e-5)


def test_blocks_of_sixteen_are_cut() -> None:
    attributes = ("probability", "state"), (o3c.float32, o3c.uint8), ((1,), (1,))
    grid = o3d.t.geometry.VoxelBlockGrid(*attributes, 0.05, 16, 4, o3c.Device("cpu:0"))
    rows, _ = grid.hashmap().activate(o3c.Tensor(np.array([[-1, 0, 2]], np.int32)))
    state = np.zeros((1, 16, 16, 16, 1), np.uint8)
    state[0, 3, 9, 14] = OCCUPIED  # z, y, x
    grid.attribute("state")[rows.to(o3c.int64)] = o3c.Tensor(state)
    occupancy = from_voxel_block_grid(grid, 0.05)
    assert len(occupancy.keys) == 8
    assert (np.diff(pack_voxels(occupancy.keys)) > 0).all()
    np.testing.assert_array_equal(occupancy.occupied_voxels(), [[-16 + 14, 9, 32 + 3]])


def test_an_empty_map_and_a_grid_of_something_else(wall: Occupancy) -> None:
    empty = replace(
        wall, **{name: getattr(wall, name)[:0] for name in ("keys", "probability", "free", "hits", "state")}
    )
    empty = replace(empty, colors=wall.colors[:0], features=wall.features[:0])
    assert len(from_voxel_block_grid(to_voxel_block_grid(empty), 0.08).keys) == 0
    tsdf = o3d.t.geometry.VoxelBlockGrid(("tsdf",), (o3c.float32,), ((1,),), 0.05, 8, 4, o3c.Device("cpu:0"))
    with pytest.raises(FreeOccError, match="holds no occupancy"):
        from_voxel_block_grid(tsdf, 0.05)
