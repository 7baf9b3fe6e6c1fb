"""Gaussians as Open3D's point cloud, and as its file."""

import numpy as np
from scenes import random_gaussians

from freeocc3d.gaussians.point_cloud import read_gaussian_ply, to_point_cloud, write_gaussian_ply


def test_gaussians_survive_the_point_cloud_and_the_file_exactly(tmp_path) -> None:
    g = random_gaussians(50, seed=0)
    write_gaussian_ply(g, tmp_path / "g.ply")
    again = read_gaussian_ply(tmp_path / "g.ply")
    for name in g.__dataclass_fields__:
        np.testing.assert_array_equal(getattr(again, name), getattr(g, name))
        assert getattr(again, name).dtype == getattr(g, name).dtype


def test_the_point_cloud_shares_memory(tmp_path) -> None:
    g = random_gaussians(5, seed=1)
    cloud = to_point_cloud(g)
    g.scales[2] = 7.0
    assert (cloud.point["scale"].numpy()[2] == 7.0).all()
