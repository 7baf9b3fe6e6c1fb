"""Exports, read back with NumPy and Open3D."""

from types import SimpleNamespace

import numpy as np
import pytest
from manifests import tiny_manifest
from scenes import occupancy_of

from freeocc3d.core.errors import ConfigError, ExportError
from freeocc3d.export import export_map, npz, ply
from freeocc3d.query.regions import Region
from freeocc3d.viewer.distinct_colors import distinct_colors

OCCUPIED = [(-9, 2, 0), (-8, 2, 0), (5, -3, 7), (6, 7, 8), (6, 7, 9)]
FREE = [(-9, 3, 0), (0, 0, 0), (6, 7, 10)]


def map_of(occupancy, labels=None):
    labels = np.zeros(len(occupancy.occupied_voxels()), np.uint8) if labels is None else np.uint8(labels)
    return SimpleNamespace(
        metric=True,
        up=np.array((0.0, 0.0, 1.0)),
        occupancy=occupancy,
        manifest=tiny_manifest(),
        vocabulary=["cup", "table"],
        labels=lambda: labels,
    )


def asymmetric():
    colors = [(200, 10, 10), (10, 200, 10), (10, 10, 200), (90, 80, 70), (1, 2, 3)]
    return occupancy_of(OCCUPIED, colors=colors, free=FREE, origin=(0.5, -0.25, 2.0))


def test_npz_agrees_voxel_by_voxel(tmp_path) -> None:
    export_map(map_of(asymmetric()), "npz", tmp_path / "map.npz")
    with np.load(tmp_path / "map.npz", allow_pickle=False) as file:
        grid, origin, size = file["occupancy"], file["origin"], float(file["voxel_size"])
        assert grid.dtype == np.uint8
        assert file["probability"].dtype == np.float16
        np.testing.assert_array_equal(file["T_world_map"], np.eye(4))
    expected = {tuple(v): 1 for v in OCCUPIED} | {tuple(v): 0 for v in FREE}
    for (i, j, k), value in expected.items():
        center = np.array((0.5, -0.25, 2.0)) + (np.array((i, j, k)) + 0.5) * 0.1
        assert grid[tuple(np.floor((center - origin) / size).astype(int))] == value
    assert (grid == 1).sum() == len(OCCUPIED)
    assert (grid == 0).sum() == len(FREE)
    assert (grid == 255).sum() == grid.size - len(OCCUPIED) - len(FREE)


def test_npz_labels_keep_free_class_and_nothing_known_apart(tmp_path) -> None:
    occupancy = asymmetric()
    labels = [1, 1, 0, 1, 1]  # the class with the highest number does not occur
    export_map(map_of(occupancy, labels), "npz", tmp_path / "map.npz")
    with np.load(tmp_path / "map.npz") as file:
        grid, origin = file["labels"], file["origin"]
        assert file["classes"].tolist() == ["cup", "table"]
    at = np.floor((occupancy.centers(occupancy.occupied_voxels()) - origin) / 0.1).astype(int)
    assert grid[tuple(at.T)].tolist() == [1, 1, 3, 1, 1]
    assert set(np.unique(grid)) == {0, 1, 3, 255}


def test_npz_sparse_lists_the_known_voxels(tmp_path) -> None:
    export_map(map_of(asymmetric()), "npz", tmp_path / "map.npz", {"form": "sparse"})
    with np.load(tmp_path / "map.npz") as file:
        found = dict(zip(map(tuple, file["voxels"].tolist()), file["state"].tolist(), strict=True))
    assert found == {tuple(v): 1 for v in OCCUPIED} | {tuple(v): 0 for v in FREE}


def test_a_dense_grid_that_would_not_fit_is_refused_before_memory_is_taken(tmp_path) -> None:
    far = occupancy_of([(0, 0, 0), (100_000, 100_000, 900)])
    with pytest.raises(ExportError, match="form=sparse"):
        export_map(map_of(far), "npz", tmp_path / "map.npz")
    export_map(map_of(far), "npz", tmp_path / "map.npz", {"form": "sparse"})
    assert [p.name for p in tmp_path.iterdir()] == ["map.npz"]


@pytest.mark.parametrize(
    ("voxels", "faces"),
    [
        ([(0, 0, 0)], 6),
        ([(0, 0, 0), (1, 0, 0)], 10),
        ([(7, 3, 3), (8, 3, 3)], 10),  # across a block's border
        ([(-1, -1, -1), (-1, -1, 0)], 10),
        ([tuple(v) for v in np.indices((3, 3, 3)).reshape(3, -1).T], 54),
        ([(0, 0, 0), (1, 1, 1)], 12),
    ],
)
def test_cubes_have_only_their_outer_faces_facing_outwards(tmp_path, voxels, faces) -> None:
    import open3d as o3d

    export_map(map_of(occupancy_of(voxels)), "ply", tmp_path / "map.ply")
    mesh = o3d.io.read_triangle_mesh(str(tmp_path / "map.ply"))
    assert len(mesh.triangles) == 2 * faces
    corners = np.asarray(mesh.vertices)[np.asarray(mesh.triangles)]
    a, b, c = corners.transpose(1, 0, 2)
    volume = np.einsum("ni,ni->n", a, np.cross(b, c)).sum() / 6  # of a closed surface that faces outwards
    assert volume == pytest.approx(len(voxels) * 1e-3, rel=1e-4)
    np.testing.assert_allclose(np.asarray(mesh.vertices).min(axis=0), 0.1 * np.min(voxels, axis=0), atol=1e-6)


def test_points_and_colors(tmp_path) -> None:
    import open3d as o3d

    occupancy = asymmetric()
    export_map(map_of(occupancy), "ply", tmp_path / "map.ply", {"form": "points"})
    cloud = o3d.io.read_point_cloud(str(tmp_path / "map.ply"))
    np.testing.assert_allclose(np.asarray(cloud.points), occupancy.centers(occupancy.occupied_voxels()), atol=1e-5)
    np.testing.assert_array_equal(np.rint(255 * np.asarray(cloud.colors)), occupancy.colors)


def test_a_querys_matches_stand_out(tmp_path) -> None:
    import open3d as o3d

    occupancy = asymmetric()
    region = Region(0.9, 0.9, np.zeros(3), np.zeros(3), np.ones(3), 1e-3, np.array([2]))
    result = SimpleNamespace(regions=[region])
    ply.write_query_ply(occupancy, [result], tmp_path / "q.ply")
    mesh = o3d.io.read_triangle_mesh(str(tmp_path / "q.ply"))
    strong = (np.rint(255 * np.asarray(mesh.vertex_colors)) == distinct_colors(1)[0]).all(axis=1)
    assert strong.sum() == 24
    center = occupancy.centers(occupancy.occupied_voxels())[2]
    assert np.abs(np.asarray(mesh.vertices)[strong] - center).max() < 0.051


def test_bad_requests_are_reported_and_leave_nothing(tmp_path) -> None:
    good = map_of(asymmetric())
    with pytest.raises(ConfigError, match="npz"):
        export_map(good, "npy", tmp_path / "a")
    with pytest.raises(ConfigError, match="form"):
        export_map(good, "npz", tmp_path / "a", {"from": "dense"})
    with pytest.raises(ConfigError, match="dense or sparse"):
        export_map(good, "npz", tmp_path / "a", {"form": "octree"})
    with pytest.raises(ExportError, match="no occupied voxels"):
        export_map(map_of(occupancy_of([])), "ply", tmp_path / "a.ply")
    with pytest.raises(ExportError, match="Cannot write"):
        export_map(good, "ply", tmp_path / "missing" / "a.ply")
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "taken.npz").write_text("mine")
    with pytest.raises(ExportError, match="--overwrite"):
        export_map(good, "npz", tmp_path / "taken.npz")
    assert (tmp_path / "taken.npz").read_text() == "mine"
    export_map(good, "npz", tmp_path / "taken.npz", overwrite=True)
    assert npz.sparse(asymmetric(), np.zeros(5, np.uint8), 2)["state"].sum() == 5
