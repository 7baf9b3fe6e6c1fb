"""Point clouds: each form against known points, and damage in a sentence."""

from pathlib import Path

import numpy as np
import open3d as o3d
import pytest

from freeocc3d.capture.point_files import read_points
from freeocc3d.core.errors import CaptureError

POINTS = np.random.default_rng(0).uniform(-2, 2, (40, 3))


def write(path: Path, **options: bool) -> Path:
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(POINTS))
    cloud.colors = o3d.utility.Vector3dVector(np.full_like(POINTS, 0.5))
    assert o3d.io.write_point_cloud(str(path), cloud, **options)
    return path


@pytest.mark.parametrize("name", ["cloud.ply", "cloud.pcd", "cloud.xyz"])
@pytest.mark.parametrize("options", [{}, {"write_ascii": True}, {"compressed": True}])
def test_each_form_gives_its_points(tmp_path: Path, name: str, options: dict[str, bool]) -> None:
    np.testing.assert_allclose(read_points(write(tmp_path / name, **options)), POINTS, atol=1e-5)


@pytest.mark.parametrize("name", ["cloud.ply", "cloud.pcd"])
@pytest.mark.parametrize("options", [{}, {"write_ascii": True}, {"compressed": True}])
def test_a_cut_file_or_a_wrong_count_is_refused(tmp_path: Path, name: str, options: dict[str, bool]) -> None:
    path = write(tmp_path / name, **options)
    data = path.read_bytes()
    for damaged in (data[: len(data) // 2], data.replace(b"40\n", b"4000000000\n"), data.replace(b"40\n", b"-1\n")):
        path.write_bytes(damaged)
        with pytest.raises(CaptureError, match=r"cloud\.\w+ is not a readable point cloud"):
            read_points(path)


def test_points_that_are_not_finite_are_left_out_and_impossible_ones_refused(tmp_path: Path) -> None:
    (tmp_path / "cloud.xyz").write_text("1 2 3\nnan 0 0\n0 inf 0\n")
    np.testing.assert_array_equal(read_points(tmp_path / "cloud.xyz"), [[1, 2, 3]])
    for text, told in (
        ("1e300 0 0\n", "farther away than is possible"),
        ("1 2\n", "too few"),
        ("", "it is empty"),
        ("# none\n", "holds no points"),
    ):
        (tmp_path / "cloud.xyz").write_text(text)
        with pytest.raises(CaptureError, match=told):
            read_points(tmp_path / "cloud.xyz")
