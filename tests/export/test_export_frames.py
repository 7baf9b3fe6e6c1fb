"""Exports in other frames than the map's."""

import numpy as np
import pytest
from exported_maps import CAMERA_TO_UP, SPACE, VOXELS, map_of
from scenes import occupancy_of

from freeocc3d.core.errors import ConfigError, ExportError
from freeocc3d.core.transforms import transform
from freeocc3d.core.types import FREE, OCCUPIED, Occupancy
from freeocc3d.export import export_map
from freeocc3d.export.export_frames import place_voxels


def test_a_voxel_ahead_below_and_right_is_there_in_each_frame() -> None:
    scan_map = map_of(occupancy_of(VOXELS, free=SPACE))
    center = scan_map.occupancy.centers(scan_map.occupancy.occupied_voxels())
    np.testing.assert_array_equal(place_voxels(scan_map, "map").occupancy.keys, scan_map.occupancy.keys)
    for frame, height in (("gravity", 1.52), ("start", 0.0)):
        there = place_voxels(scan_map, frame)
        expected = np.stack((center[:, 2], -center[:, 0], height - center[:, 1]), axis=1)
        np.testing.assert_allclose(transform(there.T_frame_map, center), expected, atol=1e-9)
        found = there.occupancy.centers(there.occupancy.occupied_voxels())
        assert len(found) == 3
        assert np.abs(found - expected[there.rows]).max() <= 0.05 + 1e-6


def test_the_first_cameras_own_frame_looks_along_z() -> None:
    """The pose of a level camera, at 1.52 m, that looks along x."""
    scan_map = map_of(occupancy_of(VOXELS, free=SPACE), np.eye(4))
    scan_map.trajectory.T_world_cam[1], scan_map.up = CAMERA_TO_UP, np.array((0.0, 0.0, 1.0))
    there = place_voxels(scan_map, "first-camera")
    np.testing.assert_allclose(there.T_frame_map @ CAMERA_TO_UP, np.eye(4), atol=1e-9)
    assert there.described()["up"] == [0, -1, 0]
    np.testing.assert_allclose(place_voxels(scan_map, "start").up, (0, 0, 1))


@pytest.mark.parametrize("frame", ["map", "gravity"])
def test_voxels_of_an_upright_map_keep_their_places(frame) -> None:
    """Also on the lattice of a tree, whose frame then moves, the floor's layer to below 0."""
    occupancy = occupancy_of(VOXELS, free=SPACE).replace(origin=np.array((-0.03, -0.06, -0.05)))
    scan_map = map_of(occupancy, np.eye(4))
    there = place_voxels(scan_map, frame)
    np.testing.assert_array_equal(there.T_frame_map, np.eye(4))
    np.testing.assert_array_equal(there.occupancy.origin, occupancy.origin)
    moved = place_voxels(scan_map, frame, origin=(0, 0, 0))
    np.testing.assert_array_equal(moved.occupancy.keys, occupancy.keys)
    np.testing.assert_allclose(moved.T_frame_map[:3, 3], (0.03, -0.04, -0.05), atol=1e-9)
    np.testing.assert_allclose(moved.occupancy.origin, (0, -0.1, -0.1), atol=1e-9)
    assert set(scan_map.T_gravity_map.ravel()) == {0, 1}


def test_an_npz_in_another_frame_says_where_it_is(tmp_path) -> None:
    scan_map = map_of(occupancy_of(VOXELS, free=SPACE))
    export_map(scan_map, "npz", tmp_path / "map.npz", {"frame": "gravity"})
    with np.load(tmp_path / "map.npz") as file:
        grid, origin, size, T = (file[name] for name in ("occupancy", "origin", "voxel_size", "T_world_map"))
        labels = file["labels"]
        assert str(file["frame"]) == "gravity"
    inside = np.argwhere(grid == 1)
    world = transform(T, origin + (inside + 0.5) * float(size))
    center = scan_map.occupancy.centers(scan_map.occupancy.occupied_voxels())
    distance = np.linalg.norm(world[:, None] - center, axis=2)
    assert distance.min(axis=1).max() < 0.09
    row = distance.argmin(axis=1)
    np.testing.assert_array_equal(labels[grid == 1], np.where(row % 3, row % 3, 3))


def test_a_ply_names_its_frame_and_keeps_colors(tmp_path) -> None:
    import open3d as o3d

    scan_map = map_of(occupancy_of(VOXELS, colors=[(255, 0, 0), (0, 255, 0), (0, 0, 255)]))
    export_map(scan_map, "ply", tmp_path / "map.ply", {"frame": "gravity", "form": "points"})
    cloud = o3d.io.read_point_cloud(str(tmp_path / "map.ply"))
    blue = np.asarray(cloud.points)[np.asarray(cloud.colors)[:, 2] > 0.5]
    np.testing.assert_allclose(blue, [(2.15, -0.35, 1.52 - 0.55)], atol=0.051)
    assert b'comment frame "gravity"' in (tmp_path / "map.ply").read_bytes()[:400]


def test_a_map_of_several_sizes_is_brought_to_the_largest() -> None:
    keys = np.array([(0, 0, 0), (2, 0, 0), (5, 1, 1)], np.int32)  # a coarse block, and two of half the size
    state = np.full((3, 512), 255, np.uint8)
    state[0, :64], state[1, 5], state[2, 9] = FREE, OCCUPIED, OCCUPIED
    several = Occupancy(
        0.1, np.zeros(3), keys, np.where(state == OCCUPIED, 0.9, 0.1).astype(np.float32),
        np.zeros_like(state, np.uint16), np.zeros_like(state, np.uint16), state,
        features=np.ones((2, 4), np.float16), colors=np.uint8([(1, 2, 3), (4, 5, 6)]), levels=np.uint8([0, 1, 1]),
    )  # fmt: skip
    there = place_voxels(map_of(several), "gravity")
    assert there.occupancy.deepest == 0
    assert there.occupancy.voxel_size == 0.1
    assert set(there.rows.tolist()) == {0, 1}
    np.testing.assert_array_equal(there.occupancy.colors, several.colors[there.rows])
    center = transform(there.T_frame_map, several.centers(several.occupied_voxels(), several.occupied_edges()))
    found = there.occupancy.centers(there.occupancy.occupied_voxels())
    assert np.abs(found - center[there.rows]).max() < 0.11
    in_map = place_voxels(map_of(several), "map")
    assert in_map.occupancy.deepest == 1
    assert place_voxels(map_of(several), "map", one_size=True).occupancy.deepest == 0


def test_bad_frames_are_reported(tmp_path) -> None:
    scan_map = map_of(occupancy_of(VOXELS))
    with pytest.raises(ConfigError, match="map, gravity, start or first-camera, got 'robot'"):
        export_map(scan_map, "npz", tmp_path / "a.npz", {"frame": "robot"})
    with pytest.raises(ExportError, match="no known voxels"):
        place_voxels(map_of(occupancy_of([])), "gravity")
    scan_map.trajectory.has_pose[:] = False
    with pytest.raises(ExportError, match="no first camera"):
        place_voxels(scan_map, "first-camera")


@pytest.mark.parametrize("frame", ["map", "gravity"])
def test_a_box_holds_the_voxels_whose_centers_lie_in_it(frame) -> None:
    rng = np.random.default_rng(0)
    voxels = np.unique(rng.integers(-12, 12, (300, 3)), axis=0)
    occupied, free = voxels[::2], voxels[1::2]
    scan_map = map_of(occupancy_of(occupied, colors=rng.integers(0, 255, (len(occupied), 3)), free=free))
    box = (-0.62, -0.31, -0.78, 0.57, 0.74, 0.92)
    every, part = place_voxels(scan_map, frame), place_voxels(scan_map, frame, box=box)
    for state in (FREE, OCCUPIED):
        centers = every.occupancy.centers(every.occupancy.voxels(state))
        inside = ((centers > box[:3]) & (centers < box[3:])).all(axis=1)
        assert inside.any() or frame == "gravity"
        np.testing.assert_allclose(part.occupancy.centers(part.occupancy.voxels(state)), centers[inside])
    np.testing.assert_array_equal(part.rows, every.rows[inside])
    np.testing.assert_array_equal(part.occupancy.colors, every.occupancy.colors[inside])
    assert len(part.occupancy.keys) < len(every.occupancy.keys)
    assert len(part.occupancy.features) == len(part.rows)


def test_a_box_of_a_map_of_several_sizes() -> None:
    from exported_maps import of_several_sizes

    several = of_several_sizes()
    part = place_voxels(map_of(several), "map", box=(0.0, 0.0, 0.0, 5.0, 1.0, 1.0)).occupancy
    for state in (FREE, OCCUPIED):
        centers, edges = several.centers(several.voxels(state), several.edges(state)), several.edges(state)
        inside = ((centers > 0) & (centers < (5, 1, 1))).all(axis=1)
        # Of the part, the smallest voxels may be larger than those of the whole.
        np.testing.assert_allclose(part.centers(part.voxels(state), part.edges(state)), centers[inside])
        np.testing.assert_allclose(part.edges(state) * part.finest, edges[inside] * several.finest)
