"""COLMAP models and nerfstudio folders as captures."""

from __future__ import annotations

import json
import re
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
        (
            "file_path",
            "../../elsewhere.png",
            True,
            "Only one of the 2 images .* the first that is missing is ../../elsew",
        ),
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
    write_image(tmp_path / "images" / "frame_1.png", color_image(0, (24, 32)))
    write_image(tmp_path / "images" / "frame_2.png", color_image(2, (16, 12)))
    capture = open_capture(tmp_path)
    (tmp_path / "images" / "frame_0.png").unlink()
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
    (tmp_path / "outside" / "images" / "view1.png").rename(tmp_path / "view1.png")
    with pytest.raises(
        CaptureError, match=r"Only one of the 2 images that the model .* missing is \.\./\.\./\.\./view1\.png"
    ):
        open_capture(tmp_path / "outside")


def rewrite(file: Path, change) -> None:
    file.write_text(change(file.read_text()))


@pytest.mark.parametrize(
    ("place", "images"),
    [("colmap/sparse/0", "images"), ("colmap/sparse/0", "colmap/images"), ("sparse/3", "images"),
     ("dense/sparse", "dense/images"), ("dense/0/sparse", "dense/0/images"), ("0", "images"), ("", "images")],
)  # fmt: skip
def test_models_are_found_where_programs_write_them(tmp_path: Path, place: str, images: str) -> None:
    write_colmap(tmp_path, 3, place=place)
    if images != "images":
        (tmp_path / "images").rename(tmp_path / images)
    capture = open_capture(tmp_path)
    assert capture.format == "colmap_model"
    np.testing.assert_array_equal(capture[2].color, color_image(2))
    assert capture.warnings == ()


@pytest.mark.parametrize("form", ["txt", "bin"])
def test_the_largest_of_several_models_is_taken(tmp_path: Path, form: str) -> None:
    for number, count in ((0, 2), (1, 5), (10, 3)):
        write_colmap(tmp_path, count, place=f"sparse/{number}")
        if form == "bin":
            model = pycolmap.Reconstruction(str(tmp_path / "sparse" / str(number)))
            for file in (tmp_path / "sparse" / str(number)).iterdir():
                file.unlink()
            model.write_binary(str(tmp_path / "sparse" / str(number)))
    capture = open_capture(tmp_path)
    assert len(capture) == 5
    (notice,) = capture.warnings
    assert notice.code == "models-apart"
    assert "holds 3 models: 1 with 5 images is taken; 10 with 3, 0 with 2 are left out" in notice.text
    assert len(read_poses(tmp_path).timestamps) == 5
    if form == "bin":  # a damaged count does not make a model the largest
        file = tmp_path / "sparse" / "0" / "images.bin"
        file.write_bytes((1 << 60).to_bytes(8, "little") + file.read_bytes()[8:])
        assert len(open_capture(tmp_path)) == 5


@pytest.mark.parametrize(
    "change",
    [
        lambda name: name.upper(),
        lambda name: name.replace(".png", ".JPG"),
        lambda name: "D:\\scan\\images\\" + name,
        lambda name: "/home/me/scan/images/" + name,
        lambda name: "left/" + name,
    ],
)
def test_names_of_a_model_are_those_of_files_where_that_is_clear(tmp_path: Path, change) -> None:
    write_colmap(tmp_path, 3)
    rewrite(tmp_path / "sparse/0/images.txt", lambda text: re.sub(r"view\d\.png", lambda m: change(m[0]), text))
    capture = open_capture(tmp_path)
    assert [capture.name(i) for i in range(3)] == ["view0.png", "view1.png", "view2.png"]
    np.testing.assert_allclose(capture.pose(2)[:3, :3], pose_matrix(2)[:3, :3], atol=1e-9)
    assert capture.warnings == ()


def test_names_may_have_spaces(tmp_path: Path) -> None:
    write_colmap(tmp_path, 3)
    for i in range(3):
        (tmp_path / f"images/view{i}.png").rename(tmp_path / f"images/my view {i}.png")
    rewrite(tmp_path / "sparse/0/images.txt", lambda text: text.replace("view", "my view "))
    assert open_capture(tmp_path).name(1) == "my view 1.png"


@pytest.mark.parametrize("form", ["colmap", "nerfstudio"])
def test_images_that_are_listed_but_missing_are_left_out_at_opening(tmp_path: Path, form: str) -> None:
    if form == "colmap":
        folder, first = write_colmap(tmp_path, 6) / "images", "view0.png"
        names = [f"view{i}.png" for i in (0, 3, 4)]
    else:
        folder, first = write_nerfstudio(tmp_path, 6) / "images", "images/frame_4.png"  # the list is in reverse
        names = [f"frame_{i}.png" for i in (0, 3, 4)]
    for name in names:
        (folder / name).unlink()
    capture = open_capture(tmp_path)
    assert len(capture) == 3
    np.testing.assert_array_equal(capture[1].color, color_image(2))
    np.testing.assert_allclose(capture.pose(1)[:3, :3], pose_matrix(2)[:3, :3], atol=1e-9)
    (notice,) = capture.warnings
    assert notice.code == "images-left-out"
    assert notice.text.startswith("3 of the 6 images that ")
    assert f"the first is {first}" in notice.text
    for name in names:
        (folder / name).touch()
    for file in folder.iterdir():
        file.rename(folder / f"other_{file.stem}.tif")
    with pytest.raises(CaptureError, match=r"None of the 6 images .*there is other_\w+\.tif"):
        open_capture(tmp_path)


@pytest.mark.parametrize(
    "write",
    [
        lambda text: text.replace("images/", "images\\\\").replace("depth/", "depth\\\\"),
        lambda text: text.replace("images/", "C:/Users/me/scan/images/").replace("depth/", "/x/depth/"),
        lambda text: text.replace("images/", "./images/").replace("depth/", "../scan/depth/"),
        lambda text: "\ufeff" + text.replace(", ", ",\r\n"),
        lambda text: text.replace("images/frame", "Images/Frame").replace(".png", ".PNG"),
        lambda text: text.replace(".png", ""),
    ],
)
def test_transforms_from_other_machines_name_files_that_are_found(tmp_path: Path, write) -> None:
    rewrite(write_nerfstudio(tmp_path, 6) / "transforms.json", write)
    capture = open_capture(tmp_path)
    assert (len(capture), capture.warnings) == (6, ())
    np.testing.assert_array_equal(capture[5].color, color_image(5))
    np.testing.assert_allclose(capture[5].depth_m[:, 1:], 2.05, atol=1e-6)


def test_depth_that_is_listed_but_missing_is_told(tmp_path: Path) -> None:
    write_nerfstudio(tmp_path, 4)
    (tmp_path / "depth" / "frame_2.png").unlink()
    capture = open_capture(tmp_path)
    assert not capture[2].depth_m.any()
    assert [notice.text[:50] for notice in capture.warnings] == ["1 of the 4 depth images that transforms.json names"]
    for i in (0, 1, 3):
        (tmp_path / "depth" / f"frame_{i}.png").unlink()
    with pytest.raises(CaptureError, match="None of the 4 depth images that transforms"):
        open_capture(tmp_path)
    assert len(open_capture(tmp_path, Options(depth=False))) == 4


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
