from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from small_captures import (
    camera_matrix,
    class_image,
    color_image,
    pose_matrix,
    write_image,
    write_matrix,
    write_scannet,
)

from freeocc3d.capture.base import Options
from freeocc3d.capture.cameras.depth_registration import OVERLAP_PX, DepthPatches, PixelGrid
from freeocc3d.capture.readers.scannet import Reader
from freeocc3d.core.errors import CaptureError
from freeocc3d.core.transforms import back_project, invert, project, transform
from freeocc3d.core.types import Intrinsics


def test_frames_are_in_the_order_of_their_numbers(tmp_path: Path) -> None:
    capture = Reader(write_scannet(tmp_path, 12), Options())
    assert [int(capture[i].color[0, 0, 2]) for i in range(12)] == [10 * i for i in range(12)]
    np.testing.assert_allclose([capture[i].depth_m.max() for i in range(12)], 2.0 + 0.01 * np.arange(12), atol=1e-6)
    np.testing.assert_allclose(capture.pose(11), pose_matrix(11))
    np.testing.assert_array_equal(capture.timestamps, np.arange(12))


def test_hidden_files_and_time_stamps_are_no_frames(tmp_path: Path) -> None:
    write_scannet(tmp_path, 2)
    (tmp_path / "color" / "._1.png").write_bytes(b"")
    write_image(tmp_path / "color" / "1305031102.175304.png", color_image(0))
    assert len(Reader(tmp_path, Options())) == 2


def test_a_pose_of_minus_infinity_is_none(tmp_path: Path) -> None:
    capture = Reader(write_scannet(tmp_path, 2), Options())
    write_matrix(tmp_path / "pose" / "0.txt", np.full((4, 4), -np.inf))
    assert capture.pose(0) is None
    assert capture.pose(1) is not None


def test_a_recording_has_no_poses(tmp_path: Path) -> None:
    capture = Reader(write_scannet(tmp_path, 2, poses=False), Options())
    assert capture.pose(0) is None


def test_class_images_need_names(tmp_path: Path) -> None:
    write_scannet(tmp_path, 1, color_size=(64, 48))
    write_image(tmp_path / "label-filt" / "0.png", class_image((64, 48)).astype(np.uint16))
    assert Reader(tmp_path, Options()).labels(0) is None
    (tmp_path / "classes.json").write_text(json.dumps({"classes": ["nothing", "sofa", "lamp"]}))
    np.testing.assert_array_equal(Reader(tmp_path, Options()).labels(0), class_image())


def test_no_intrinsics_at_all(tmp_path: Path) -> None:
    write_scannet(tmp_path, 1)
    for path in (tmp_path / "intrinsic").iterdir():
        path.unlink()
    unknown = Reader(tmp_path, Options())
    assert not unknown.intrinsics_known
    assert not unknown.focal_stated
    given = Reader(tmp_path, Options(intrinsics=(32.0, 32.0, 15.5, 11.5)))
    assert given.intrinsics_known
    assert given[0].intrinsics.fx == 32.0
    assert Reader(tmp_path, Options(focal=40.0))[0].intrinsics == Intrinsics(32, 24, 40.0, 40.0, 15.5, 11.5)


@pytest.mark.parametrize("kind", ["color", "depth"])
def test_one_camera_of_two_is_enough_for_one_view(tmp_path: Path, kind: str) -> None:
    write_scannet(tmp_path, 1, color_size=(64, 48))
    (tmp_path / "intrinsic" / f"intrinsic_{kind}.txt").unlink()
    intrinsics = Reader(tmp_path, Options())[0].intrinsics
    np.testing.assert_allclose(intrinsics.matrix, camera_matrix(), atol=1e-12)


def test_the_camera_file_of_open3ds_recorder(tmp_path: Path) -> None:
    write_scannet(tmp_path, 1)
    for path in (tmp_path / "intrinsic").iterdir():
        path.unlink()
    matrix = {"width": 64, "height": 48, "intrinsic_matrix": camera_matrix((64, 48)).T.reshape(9).tolist()}
    (tmp_path / "camera_intrinsic.json").write_text(json.dumps(matrix))
    intrinsics = Reader(tmp_path, Options())[0].intrinsics
    np.testing.assert_allclose(intrinsics.matrix, camera_matrix(), atol=1e-12)


def test_a_larger_color_image_comes_down_to_the_depths_size(tmp_path: Path) -> None:
    capture = Reader(write_scannet(tmp_path, 1, color_size=(96, 72)), Options())
    frame = capture[0]
    assert frame.color.shape == (24, 32, 3)
    np.testing.assert_allclose(frame.intrinsics.matrix, camera_matrix())
    areas = color_image(0, (96, 72)).astype(float).reshape(24, 3, 32, 3, 3).mean(axis=(1, 3))
    np.testing.assert_allclose(frame.color, areas, atol=0.51)
    np.testing.assert_allclose(frame.depth_m[:, 1:], 2.0)


def test_color_is_resampled_through_both_cameras() -> None:
    """The color camera sees less than the depth camera and off its center; what a ray sees is known analytically."""
    depth_camera = Intrinsics(64, 48, 50.0, 52.0, 31.0, 23.0)
    color_camera = Intrinsics(128, 96, 130.0, 126.0, 65.0, 45.0)
    grid = PixelGrid(color_camera, depth_camera)
    v, u = np.mgrid[:96, :128]
    x, y = (u - 65.0) / 130.0, (v - 45.0) / 126.0
    image = np.stack((128 + 200 * x, 128 + 200 * y, np.zeros(x.shape)), axis=-1).round().astype(np.uint8)
    depth_m = grid.depth(np.full((48, 64), 2.0, np.float32))
    color = grid.color(image).astype(float)
    assert grid.intrinsics == depth_camera
    v, u = np.nonzero(depth_m)
    interior = (v > v.min()) & (v < v.max()) & (u > u.min()) & (u < u.max())
    v, u = v[interior], u[interior]
    expected = np.stack((128 + 200 * (u - 31.0) / 50.0, 128 + 200 * (v - 23.0) / 52.0), axis=-1)
    np.testing.assert_allclose(color[v, u, :2], expected, atol=1.5)
    # The first ray that color sees, x = -65.5 / 130, is depth column 31 - 50 * 65.5 / 130 = 5.8.
    assert np.nonzero(depth_m.any(axis=0))[0][0] == 6


def test_cameras_that_coincide_change_nothing() -> None:
    camera = Intrinsics(32, 24, 32.0, 32.0, 15.5, 11.5)
    grid = PixelGrid(camera, camera, np.eye(4))
    image, depth_m = color_image(0), np.full((24, 32), 2.0, np.float32)
    assert grid.color(image) is image
    assert grid.depth(depth_m) is depth_m
    assert depth_m.all()


def plane_depth(camera: Intrinsics, T_plane_cam: np.ndarray) -> np.ndarray:
    """(H, W) depth of the plane z = 0 of the plane's frame."""
    v, u = np.mgrid[: camera.height, : camera.width]
    rays = back_project(np.stack((u, v), axis=-1), np.ones(u.shape), camera)
    return -T_plane_cam[2, 3] / (rays @ T_plane_cam[2, :3])


def rotation_y(degrees: float) -> np.ndarray:
    c, s = np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))
    T = np.eye(4)
    T[:3, :3] = [[c, 0, s], [0, 1, 0], [-s, 0, c]]
    return T


@pytest.mark.parametrize("slant", [0.0, 35.0])
def test_a_plane_registered_to_a_shifted_narrower_camera_is_whole_and_in_place(slant: float) -> None:
    """Depth 64 x 48 at f = 40 into f = 70: each pixel has to cover about three, without holes between them."""
    depth_camera, target = Intrinsics(64, 48, 40.0, 40.0, 31.5, 23.5), Intrinsics(64, 48, 70.0, 70.0, 31.5, 23.5)
    T_target_depth = rotation_y(1.0)
    T_target_depth[:3, 3] = (-0.05, 0.01, 0.003)
    T_plane_depth = rotation_y(slant)
    T_plane_depth[2, 3] = -2.0
    measured = plane_depth(depth_camera, T_plane_depth)
    moved = DepthPatches(depth_camera, target, T_target_depth).move(measured.astype(np.float32))
    expected = plane_depth(target, T_plane_depth @ invert(T_target_depth))
    assert (moved > 0).all()
    # A patch has one depth: at its edge, half a depth pixel and the overlap from its center, it is off by the slope.
    slope_m = np.abs(np.diff(expected, axis=1)).max()
    assert np.abs(moved - expected).max() < (0.5 * 70 / 40 + OVERLAP_PX) * slope_m + 1e-5


def test_the_nearer_surface_wins() -> None:
    camera = Intrinsics(64, 48, 60.0, 60.0, 31.5, 23.5)
    depth_m = np.full((48, 64), 3.0, np.float32)
    depth_m[10:30, 20:30] = 1.0
    T_target_depth = np.eye(4)
    T_target_depth[0, 3] = 0.1
    moved = DepthPatches(camera, camera, T_target_depth).move(depth_m)
    corners = np.array([[20, 10], [29, 29]])
    pixels, _ = project(transform(T_target_depth, back_project(corners, np.ones(2), camera)), camera)
    (left, top), (right, bottom) = np.round(pixels).astype(int)
    assert (left, right) == (26, 35)
    np.testing.assert_allclose(moved[top : bottom + 1, left : right + 1], 1.0)
    # Moved by 6 pixels, the box leaves behind what it hid: 4 columns that nothing was measured in.
    assert (moved[12:28, 22 + 1 : left - 1] == 0).all()
    np.testing.assert_allclose(moved[12:28, 37:], 3.0)


def test_depth_is_moved_to_the_color_camera_by_the_extrinsics(tmp_path: Path) -> None:
    write_scannet(tmp_path, 1, color_size=(64, 48))
    T_rig_depth = np.eye(4)
    T_rig_depth[0, 3] = -0.5
    write_matrix(tmp_path / "intrinsic" / "extrinsic_depth.txt", T_rig_depth)
    write_matrix(tmp_path / "intrinsic" / "extrinsic_color.txt", np.eye(4))
    frame = Reader(tmp_path, Options())[0]
    assert frame.color.shape[:2] == frame.depth_m.shape == (24, 32)
    np.testing.assert_allclose(frame.intrinsics.matrix, camera_matrix())
    # -0.5 m at 2 m and f = 32 is 8 pixels to the left; the first column of the depth image is not measured.
    assert frame.depth_m[:, :24].all()
    assert not frame.depth_m[:, 24:].any()
    np.testing.assert_allclose(frame.depth_m[:, :24], 2.0)


def test_both_extrinsics_compose(tmp_path: Path) -> None:
    write_scannet(tmp_path, 1)
    both = np.eye(4)
    both[0, 3] = -0.5
    for camera in ("color", "depth"):
        write_matrix(tmp_path / "intrinsic" / f"extrinsic_{camera}.txt", both)
    assert Reader(tmp_path, Options())[0].depth_m[:, 1:].all()


def test_extrinsics_that_are_not_rigid_name_their_file(tmp_path: Path) -> None:
    write_scannet(tmp_path, 1)
    write_matrix(tmp_path / "intrinsic" / "extrinsic_depth.txt", np.zeros((4, 4)))
    with pytest.raises(CaptureError, match=r"extrinsic_depth\.txt must hold a rigid transform"):
        Reader(tmp_path, Options())


def test_full_size_intrinsics_with_shrunken_images_are_refused(tmp_path: Path) -> None:
    write_scannet(tmp_path, 1)
    write_matrix(tmp_path / "intrinsic" / "intrinsic_color.txt", camera_matrix((96, 72)))
    with pytest.raises(CaptureError, match=r"intrinsic_color\.txt puts the principal point .* another resolution"):
        Reader(tmp_path, Options())
