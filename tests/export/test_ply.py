"""PLY: closed surfaces, and computed colors."""

from types import SimpleNamespace

import numpy as np
import pytest
from scenes import occupancy_of

from freeocc3d.core.errors import ConfigError, ExportError
from freeocc3d.export import export_map, ply
from freeocc3d.occupancy.surface_faces import find_exposed_faces

BLUE, YELLOW = (68, 1, 84), (253, 231, 37)
"""The ends of viridis."""


def point_colors(tmp_path, occupancy, color):
    """(V, 3) colors that Open3D reads of the voxels' centers."""
    import open3d as o3d

    scan_map = SimpleNamespace(
        metric=True, occupancy=occupancy, up=np.array((0.0, -1.0, 0.0)), vocabulary=[], labels=None
    )
    export_map(scan_map, "ply", tmp_path / "map.ply", {"form": "points", "color": color}, overwrite=True)
    cloud = o3d.io.read_point_cloud(str(tmp_path / "map.ply"))
    return np.rint(255 * np.asarray(cloud.colors)).astype(int)


def test_height_runs_along_the_maps_up_and_probability_from_0_to_1(tmp_path) -> None:
    occupancy = occupancy_of([(5, -9, 0), (-9, 0, 3), (0, 9, -4)])  # up is -y
    rows = np.argsort(occupancy.occupied_voxels()[:, 1])
    highest, middle, lowest = point_colors(tmp_path, occupancy, "height")[rows]
    assert tuple(highest) == YELLOW
    assert tuple(lowest) == BLUE
    assert tuple(middle) not in (BLUE, YELLOW)

    probability = occupancy.probability.copy()
    probability[occupancy.state == 1] = (0.0, 1.0, 0.5)
    first, second, third = point_colors(tmp_path, occupancy.replace(probability=probability), "probability")
    assert tuple(first) == BLUE
    assert tuple(second) == YELLOW
    np.testing.assert_allclose(third, middle, atol=3)  # both are half way


def test_a_level_map_has_one_height(tmp_path) -> None:
    assert set(map(tuple, point_colors(tmp_path, occupancy_of([(0, 3, 0), (9, 3, -2)]), "height"))) == {BLUE}


@pytest.mark.parametrize("color", ["rgb", "height", "probability"])
def test_an_empty_map_is_refused_in_a_sentence(tmp_path, color) -> None:
    empty = SimpleNamespace(metric=True, occupancy=occupancy_of([]), up=np.array((0.0, 0.0, 1.0)))
    with pytest.raises(ExportError, match="no occupied voxels"):
        export_map(empty, "ply", tmp_path / "map.ply", {"color": color})
    with pytest.raises(ExportError, match="no occupied voxels"):
        ply.write_query_ply(empty.occupancy, [], tmp_path / "map.ply")
    assert list(tmp_path.iterdir()) == []


def test_unknown_colors_are_reported_with_those_that_exist() -> None:
    with pytest.raises(ConfigError, match="rgb, class, height or probability, got 'depth'"):
        ply.Options(color="depth")


def test_surfaces_are_closed_whatever_their_shape() -> None:
    """Each edge is walked as often in one direction as in the other."""
    rng = np.random.default_rng(3)
    occupancy = occupancy_of(np.unique(rng.integers(-10, 10, (400, 3)), axis=0))
    vertices, quads, rows = find_exposed_faces(occupancy)
    lattice = np.rint(vertices / 0.1).astype(int)
    edges = np.stack((lattice[quads], lattice[np.roll(quads, -1, axis=1)]), axis=2).reshape(-1, 6)
    forth, count_forth = np.unique(edges, axis=0, return_counts=True)
    back, count_back = np.unique(edges[:, [3, 4, 5, 0, 1, 2]], axis=0, return_counts=True)
    np.testing.assert_array_equal(forth, back)
    np.testing.assert_array_equal(count_forth, count_back)
    offset = vertices[quads].mean(axis=1) - occupancy.centers(occupancy.occupied_voxels())[rows]
    np.testing.assert_allclose(np.abs(offset).max(axis=1), 0.05, atol=1e-5)  # a face belongs to the voxel of its row
