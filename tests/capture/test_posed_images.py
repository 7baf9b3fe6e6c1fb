"""COLMAP models and nerfstudio folders as captures."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from numpy.typing import NDArray
from posed_captures import write_colmap, write_nerfstudio
from small_captures import camera_matrix, color_image, pose_matrix, write_image

from freeocc3d.capture import Options, open_capture
from freeocc3d.capture.base import NOMINAL_DEPTH
from freeocc3d.core.errors import CaptureError, ConfigError, FrameError
from freeocc3d.core.types import Intrinsics
from freeocc3d.tracking.trajectory_alignment import read_poses

DISTORTIONS = [
    ("SIMPLE_RADIAL", [52.0, 32.0, 24.0, -0.12]),
    ("RADIAL", [52.0, 32.0, 24.0, -0.12, 0.02]),
    ("OPENCV", [52.0, 53.0, 31.0, 25.0, -0.1, 0.02, 0.004, -0.003]),
    ("FULL_OPENCV", [52.0, 53.0, 31.0, 25.0, -0.1, 0.02, 0.004, -0.003, 0.01, 0.02, 0.0, 0.0]),
    ("OPENCV_FISHEYE", [40.0, 41.0, 31.0, 25.0, 0.02, -0.01, 0.0, 0.0]),
]


def test_nerfstudio_frames_have_poses_depth_and_the_camera(tmp_path: Path) -> None:
    capture = open_capture(write_nerfstudio(tmp_path, 12))
    assert capture.format == "nerfstudio"
    assert [capture.name(i) for i in (0, 2, 11)] == ["frame_0.png", "frame_2.png", "frame_11.png"]
    frame = capture[10]
    np.testing.assert_array_equal(frame.color, color_image(10))
    np.testing.assert_allclose(frame.depth_m[:, 1:], 2.1, atol=1e-6)
    np.testing.assert_allclose(frame.intrinsics.matrix, camera_matrix())
    np.testing.assert_allclose(capture.pose(10), pose_matrix(10), atol=1e-9)
    assert capture.has_depth
    assert capture.metric_poses
    assert capture.intrinsics_known
    raw = capture.raw_depth(10)
    assert raw is not None
    assert (raw[0].max(), raw[1]) == (2100, 1000.0)


def test_nerfstudio_without_depth_has_no_scale_unless_one_is_given(tmp_path: Path) -> None:
    write_nerfstudio(tmp_path, 3, depth=False)
    capture = open_capture(tmp_path)
    assert not capture.has_depth
    assert not capture.metric_poses
    assert not capture[1].depth_m.any()
    scaled = open_capture(tmp_path, Options(scale=2.5))
    assert scaled.metric_poses
    np.testing.assert_allclose(scaled.pose(2)[:3, 3], 2.5 * pose_matrix(2)[:3, 3])


def test_nerfstudio_without_depth_has_a_nominal_scale_by_its_points(tmp_path: Path) -> None:
    import open3d as o3d

    write_nerfstudio(tmp_path, 3, depth=False, ply_file_path="sparse_pc.ply")
    assert open_capture(tmp_path).pose(2)[0, 3] == pytest.approx(pose_matrix(2)[0, 3]), "the file is not there"
    points = np.random.default_rng(0).uniform((-1, -1, 8), (1, 1, 8), (200, 3))
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    o3d.io.write_point_cloud(str(tmp_path / "sparse_pc.ply"), cloud)
    capture = open_capture(tmp_path)
    assert not capture.metric_poses
    assert capture.pose(2)[0, 3] == pytest.approx(pose_matrix(2)[0, 3] * NOMINAL_DEPTH / 8, rel=0.05)
    assert open_capture(tmp_path, Options(scale=1.0)).pose(2)[0, 3] == pytest.approx(pose_matrix(2)[0, 3])


def test_a_scale_with_depth_is_refused_and_depth_can_be_left_out(tmp_path: Path) -> None:
    write_nerfstudio(tmp_path, 3)
    with pytest.raises(ConfigError, match=r"capture\.scale is for scans without depth"):
        open_capture(tmp_path, Options(scale=2.0))
    capture = open_capture(tmp_path, Options(scale=2.0, depth=False))
    assert not capture.has_depth
    assert capture.raw_depth(0) is None


def test_nerfstudio_cameras_may_be_given_by_the_angle_and_by_frame(tmp_path: Path) -> None:
    write_nerfstudio(tmp_path, 2, depth=False)
    content = json.loads((tmp_path / "transforms.json").read_text())
    for key in ("fl_x", "fl_y", "cx", "cy", "w", "h"):
        del content[key]
    content["camera_angle_x"] = 2 * np.arctan(0.5)  # as wide as far
    content["frames"][0]["fl_x"] = 40.0  # frame 1, for the list is in reverse
    for frame in content["frames"]:
        frame["file_path"] = "./" + frame["file_path"].removesuffix(".png")
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    capture = open_capture(tmp_path)
    np.testing.assert_allclose(capture[0].intrinsics.matrix, camera_matrix())
    assert capture[1].intrinsics.fx == 40.0


def test_depth_of_another_size_is_brought_to_the_colors_pixels(tmp_path: Path) -> None:
    write_nerfstudio(tmp_path, 2)
    small = np.array([[1000, 2000], [3000, 0]], np.uint16)
    write_image(tmp_path / "depth" / "frame_0.png", small)
    depth_m = open_capture(tmp_path)[0].depth_m
    found = [depth_m[y, x] for y, x in ((0, 0), (11, 15), (11, 16), (12, 15), (23, 31))]
    np.testing.assert_allclose(found, [1, 1, 2, 3, 0], atol=1e-6)


def broken_nerfstudio(folder: Path, key: str, value: object, frame: bool) -> None:
    write_nerfstudio(folder, 2, depth=False)
    content = json.loads((folder / "transforms.json").read_text())
    (content["frames"][0] if frame else content)[key] = value
    (folder / "transforms.json").write_text(json.dumps(content))


@pytest.mark.parametrize(
    ("key", "value", "frame", "said"),
    [
        ("camera_model", "EQUIRECTANGULAR", False, "camera model EQUIRECTANGULAR, which is not supported"),
        ("fl_x", "wide", False, "'fl_x' has text instead of a number"),
        ("fl_x", None, False, "states no focal length"),
        ("k4", 0.1, False, "states k4"),
        ("file_path", "../../elsewhere.png", True, "lies outside "),
        ("transform_matrix", [[1, 2], [3, 4]], True, "has 2 entries instead of 4"),
        ("frames", [], False, "not a trajectory|holds 0 images"),
    ],
)
def test_what_nerfstudio_files_lack_is_reported(
    tmp_path: Path, key: str, value: object, frame: bool, said: str
) -> None:
    broken_nerfstudio(tmp_path, key, value, frame)
    with pytest.raises(CaptureError, match=said):
        open_capture(tmp_path)


def test_an_image_that_is_missing_or_does_not_fit_its_camera_is_a_broken_frame(tmp_path: Path) -> None:
    write_nerfstudio(tmp_path, 3, depth=False)
    (tmp_path / "images" / "frame_0.png").unlink()
    write_image(tmp_path / "images" / "frame_1.png", color_image(0, (24, 32)))
    write_image(tmp_path / "images" / "frame_2.png", color_image(2, (16, 12)))
    capture = open_capture(tmp_path)
    with pytest.raises(FrameError, match=r"Cannot read .*frame_0\.png"):
        capture[0]
    with pytest.raises(FrameError, match=r"frame_1\.png has 24 x 32 pixels, but its camera has 32 x 24"):
        capture[1]
    assert capture[2].intrinsics == Intrinsics(32, 24, 32.0, 32.0, 15.5, 11.5).resized(16, 12)


@pytest.mark.parametrize("place", ["sparse/0", "sparse"])
def test_a_colmap_model_gives_poses_at_a_nominal_scale_or_a_given_one(tmp_path: Path, place: str) -> None:
    write_colmap(tmp_path, 11, place=place, depth=4.0, scale=3.0)
    capture = open_capture(tmp_path)
    assert capture.format == "colmap_model"
    assert [capture.name(i) for i in (1, 10)] == ["view1.png", "view10.png"]
    np.testing.assert_array_equal(capture[10].color, color_image(10))
    np.testing.assert_allclose(capture[10].intrinsics.matrix, camera_matrix())
    assert not capture.has_depth
    assert not capture.metric_poses
    np.testing.assert_allclose(capture.pose(10)[:3, :3], pose_matrix(10)[:3, :3], atol=1e-9)
    nominal = np.linalg.norm(capture.pose(10)[:3, 3]) / np.linalg.norm(pose_matrix(10)[:3, 3])
    assert nominal == pytest.approx(NOMINAL_DEPTH / 4.0, rel=0.1)
    metric = open_capture(tmp_path, Options(scale=1 / 3))
    assert metric.metric_poses
    np.testing.assert_allclose(metric.pose(10), pose_matrix(10), atol=1e-6)


def test_true_poses_of_a_reconstruction_are_those_of_the_numbers_in_its_names(tmp_path: Path) -> None:
    write_colmap(tmp_path, 4)
    images = tmp_path / "sparse" / "0" / "images.txt"
    images.write_text(images.read_text().replace("view3.png", "view30.png"))
    np.testing.assert_array_equal(read_poses(tmp_path).timestamps, [0, 1, 2, 30])


def test_damaged_models_and_cameras_that_are_not_read_are_reported(tmp_path: Path) -> None:
    write_colmap(tmp_path / "fov", 2, camera="FOV 32 24 30 30 16 12 0.5")
    with pytest.raises(CaptureError, match="model FOV, which is not supported: undistort"):
        open_capture(tmp_path / "fov")
    write_colmap(tmp_path / "cut", 2)
    (tmp_path / "cut" / "sparse" / "0" / "cameras.txt").unlink()
    with pytest.raises(CaptureError, match="holds no readable COLMAP model"):
        open_capture(tmp_path / "cut")
    write_colmap(tmp_path / "outside", 2)
    images = tmp_path / "outside" / "sparse" / "0" / "images.txt"
    images.write_text(images.read_text().replace("view1.png", "../../../view1.png"))
    with pytest.raises(CaptureError, match="lies outside "):
        open_capture(tmp_path / "outside")


def rays(camera: pycolmap.Camera) -> NDArray[np.float64]:
    """(H, W, 2) x/z and y/z that each pixel's center sees, by COLMAP."""
    v, u = np.mgrid[: camera.height, : camera.width]
    pixels = np.stack((u, v), axis=-1).reshape(-1, 2) + 0.5
    return np.asarray(camera.cam_from_img(pixels)).reshape(camera.height, camera.width, 2)


@pytest.mark.parametrize(("model", "params"), DISTORTIONS)
@pytest.mark.parametrize("max_size", [None, 320])
def test_distortion_is_taken_out_as_colmap_states_it(
    tmp_path: Path, model: str, params: list[float], max_size: int | None
) -> None:
    scale = 10  # a larger image, so that resampling is exact to a fraction of a gray level
    values = [scale * v if n < len(params) and abs(v) > 1 else v for n, v in enumerate(params)]
    camera = pycolmap.Camera(model=model, width=64 * scale, height=48 * scale, params=values)
    write_colmap(tmp_path, 2, camera=f"{model} {camera.width} {camera.height} {' '.join(map(str, values))}")
    seen = rays(camera)
    gray = np.clip(128 + 100 * seen, 0, 255)
    image = np.concatenate((gray, np.zeros((*gray.shape[:2], 1))), axis=-1).round().astype(np.uint8)
    write_image(tmp_path / "images" / "view0.png", image)
    frame = open_capture(tmp_path, Options(max_size=max_size))[0]
    camera_out = frame.intrinsics
    assert camera_out.width == (max_size or camera.width)
    v, u = np.mgrid[: camera_out.height, : camera_out.width]
    x, y = (u - camera_out.cx) / camera_out.fx, (v - camera_out.cy) / camera_out.fy
    expected = np.clip(128 + 100 * np.stack((x, y), axis=-1), 0, 255)
    off = np.abs(frame.color[..., :2] - expected)
    assert off.max() < 2.5
    assert off.mean() < 0.6
