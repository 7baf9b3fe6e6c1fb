"""Poses for COLMAP and nerfstudio, read by COLMAP's own library and projected."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
from exported_maps import CAMERA_TO_UP
from scenes import cameras, gaussians, wall_frame

from freeocc3d.core.errors import ConfigError, ExportError
from freeocc3d.core.transforms import invert, project, transform
from freeocc3d.export import export_map
from freeocc3d.storage.keyframes import Keyframes


@pytest.fixture
def scan_map(tmp_path):
    keyframes = Keyframes(tmp_path / "keyframes")
    for index in (0, 4, 9):
        keyframes.append(wall_frame(2.0, index))
    rng = np.random.default_rng(0)
    return SimpleNamespace(
        metric=True,
        keyframes=keyframes,
        trajectory=SimpleNamespace(T_world_keyframe=cameras(3)),
        gaussians=gaussians(rng.uniform(0, 3, (500, 3)), 0.02),
        T_gravity_map=CAMERA_TO_UP,
    )


def pixels(scan_map, row):
    """Where the points of the export stand in a keyframe's image; integers are pixel centers."""
    points = scan_map.gaussians.means.astype(float)
    camera = scan_map.keyframes.views()[row][1]
    return points, *project(transform(invert(cameras(3)[row]), points), camera)


def test_colmap_projects_the_points_to_where_the_map_does(tmp_path, scan_map) -> None:
    import pycolmap

    export_map(scan_map, "poses", tmp_path / "out")
    model = pycolmap.Reconstruction(str(tmp_path / "out" / "sparse" / "0"))
    assert model.num_points3D() == 500
    assert model.num_cameras() == 1
    for row, image in enumerate(sorted(model.images.values(), key=lambda image: image.name)):
        assert (tmp_path / "out" / "images" / image.name).is_file()
        points, expected, depth = pixels(scan_map, row)
        there = transform(CAMERA_TO_UP, points)
        for point, pixel in zip(there[depth > 0.5], expected[depth > 0.5], strict=True):
            np.testing.assert_allclose(image.project_point(point), pixel + 0.5, atol=0.05)


def test_nerfstudio_cameras_look_along_minus_z(tmp_path, scan_map) -> None:
    import open3d as o3d

    export_map(scan_map, "poses", tmp_path / "out", {"form": "nerfstudio", "points": 100})
    told = json.loads((tmp_path / "out" / "transforms.json").read_text())
    cloud = o3d.io.read_point_cloud(str(tmp_path / "out" / told["ply_file_path"]))
    assert len(cloud.points) == 100
    for row, frame in enumerate(told["frames"]):
        assert (tmp_path / "out" / frame["file_path"]).is_file()
        points, expected, depth = pixels(scan_map, row)
        x, y, z = transform(np.linalg.inv(frame["transform_matrix"]), transform(CAMERA_TO_UP, points)).T
        ahead = depth > 0.5
        np.testing.assert_allclose(-z, depth, atol=1e-6)
        u, v = frame["fl_x"] * x / -z + frame["cx"], frame["fl_y"] * -y / -z + frame["cy"]
        np.testing.assert_allclose(np.stack((u, v), axis=1)[ahead], expected[ahead] + 0.5, atol=1e-6)
    described = json.loads((tmp_path / "out" / "frame.json").read_text())
    np.testing.assert_allclose(described["T_frame_map"], CAMERA_TO_UP)


def test_what_cannot_be_written_is_reported(tmp_path, scan_map) -> None:
    with pytest.raises(ConfigError, match="colmap or nerfstudio"):
        export_map(scan_map, "poses", tmp_path / "out", {"form": "bundler"})
    export_map(scan_map, "poses", tmp_path / "out", {"points": 0})
    with pytest.raises(ExportError, match="is a folder"):
        export_map(scan_map, "poses", tmp_path / "out", overwrite=True)
    scan_map.keyframes = Keyframes(tmp_path / "none")
    scan_map.trajectory.T_world_keyframe = np.zeros((0, 4, 4))
    with pytest.raises(ExportError, match="no keyframes"):
        export_map(scan_map, "poses", tmp_path / "out2")
