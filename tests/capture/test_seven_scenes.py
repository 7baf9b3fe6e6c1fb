from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from small_captures import (
    color_image,
    data_folder,
    pose_matrix,
    truncate,
    write_image,
    write_matrix,
    write_seven_scenes,
)

from freeocc3d.capture.base import Options
from freeocc3d.capture.readers.seven_scenes import Reader
from freeocc3d.core.errors import CaptureError, FrameError
from freeocc3d.core.types import Intrinsics


def test_a_frame_has_rgb_meters_and_intrinsics(tmp_path: Path) -> None:
    capture = Reader(write_seven_scenes(tmp_path, 3), Options())
    frame = capture[2]
    assert len(capture) == 3
    assert (frame.index, frame.timestamp) == (2, 2.0)
    np.testing.assert_array_equal(frame.color, color_image(2))
    assert frame.depth_m.dtype == np.float32
    assert not frame.depth_m[:, 0].any()
    np.testing.assert_allclose(frame.depth_m[:, 1:], 2.02, atol=1e-6)
    assert frame.intrinsics == Intrinsics(32, 24, 32.0, 32.0, 15.5, 11.5)
    np.testing.assert_allclose(capture.pose(2), pose_matrix(2))
    assert capture.labels(2) is None


def test_depth_that_is_saturated_or_too_far_is_not_measured(tmp_path: Path) -> None:
    write_seven_scenes(tmp_path, 1)
    depth = np.full((24, 32), 1500, np.uint16)
    depth[0], depth[1], depth[2] = 65535, 4001, 4000
    write_image(tmp_path / "frame-000000.depth.png", depth)
    rows = Reader(tmp_path, Options(max_depth=4.0))[0].depth_m[:, 5]
    np.testing.assert_allclose(rows[:4], [0.0, 0.0, 4.0, 1.5])
    assert Reader(tmp_path, Options(max_depth=100.0))[0].depth_m[0, 5] == 0.0, "65535 is no depth at any range"


def test_depth_scale_and_intrinsics_can_be_overridden(tmp_path: Path) -> None:
    write_seven_scenes(tmp_path, 1)
    (tmp_path / "camera-intrinsics.txt").write_text("not read")
    frame = Reader(tmp_path, Options(depth_scale=2000.0, intrinsics=(30.0, 31.0, 16.0, 12.0)))[0]
    assert frame.depth_m.max() == pytest.approx(1.0)
    assert frame.intrinsics == Intrinsics(32, 24, 30.0, 31.0, 16.0, 12.0)


def test_without_a_calibration_it_is_the_kinects_at_the_images_size(tmp_path: Path) -> None:
    write_seven_scenes(tmp_path, 1)
    (tmp_path / "camera-intrinsics.txt").unlink()
    assert Reader(tmp_path, Options())[0].intrinsics == Intrinsics(640, 480, 585, 585, 320, 240).resized(32, 24)


def test_poses_are_optional_and_must_be_rigid(tmp_path: Path) -> None:
    capture = Reader(write_seven_scenes(tmp_path, 4), Options())
    (tmp_path / "frame-000000.pose.txt").unlink()
    write_matrix(tmp_path / "frame-000001.pose.txt", 2.0 * np.eye(4))
    (tmp_path / "frame-000002.pose.txt").write_text("tracking was lost")
    assert [capture.pose(i) is None for i in range(4)] == [True, True, True, False]
    far = np.eye(4)
    far[0, 3] = 1e18
    write_matrix(tmp_path / "frame-000003.pose.txt", far)
    assert capture.pose(3) is None


@pytest.mark.parametrize("suffix", ["jpg", "png"])
def test_a_cut_off_color_image_is_a_frame_error(tmp_path: Path, suffix: str) -> None:
    capture = Reader(write_seven_scenes(tmp_path, 2, suffix=suffix), Options())
    truncate(tmp_path / f"frame-000001.color.{suffix}", 0.9)
    with pytest.raises(FrameError, match=rf"frame-000001\.color\.{suffix} is cut off"):
        capture[1]
    assert capture[0].color.shape == (24, 32, 3)


def test_bytes_after_the_end_of_a_jpeg_are_no_damage(tmp_path: Path) -> None:
    path = write_seven_scenes(tmp_path, 1, suffix="jpg") / "frame-000000.color.jpg"
    path.write_bytes(path.read_bytes() + bytes(1000))
    assert Reader(tmp_path, Options())[0].color.shape == (24, 32, 3)


def test_an_exif_orientation_is_not_applied(tmp_path: Path) -> None:
    """The depth image would not turn with it."""
    path = write_seven_scenes(tmp_path, 1, suffix="jpg") / "frame-000000.color.jpg"
    turned_right = b"Exif\0\0II*\0\x08\0\0\0\x01\0\x12\x01\x03\0\x01\0\0\0\x06\0\0\0\0\0\0\0"
    data = path.read_bytes()
    path.write_bytes(data[:2] + b"\xff\xe1" + (2 + len(turned_right)).to_bytes(2, "big") + turned_right + data[2:])
    assert cv2.imread(str(path)).shape == (32, 24, 3), "the test's own EXIF is understood"
    assert Reader(tmp_path, Options())[0].color.shape == (24, 32, 3)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda path: truncate(path, 0.9), "cut off"),
        (lambda path: path.write_bytes(b""), "not a readable image"),
        (lambda path: path.unlink(), "Cannot read"),
        (
            lambda path: write_image(path, np.zeros((24, 32), np.uint8)),
            "floats, got 8-bit with 1 channel",
        ),
        (
            lambda path: write_image(path, np.zeros((24, 32, 3), np.uint16)),
            "floats, got 16-bit with 3 channels",
        ),
        (lambda path: write_image(path, np.ones((12, 16), np.uint16)), "16 x 12 pixels, but other frames have 32 x 24"),
    ],
)
def test_a_damaged_depth_image_is_a_frame_error(tmp_path: Path, damage, message: str) -> None:
    capture = Reader(write_seven_scenes(tmp_path, 2), Options())
    damage(tmp_path / "frame-000001.depth.png")
    with pytest.raises(FrameError, match=message) as caught:
        capture[1]
    assert "frame-000001.depth.png" in str(caught.value)


def test_one_image_of_another_size_is_the_broken_one_even_with_a_damaged_first_frame(tmp_path: Path) -> None:
    write_seven_scenes(tmp_path, 4)
    (tmp_path / "frame-000000.color.png").write_bytes(b"")
    write_image(tmp_path / "frame-000002.color.png", color_image(2, (16, 12)))
    capture = Reader(tmp_path, Options())
    with pytest.raises(FrameError, match=r"frame-000002\.color\.png has 16 x 12"):
        capture[2]
    assert capture[3].color.shape == (24, 32, 3)


def test_no_frame_outside_of_the_capture(tmp_path: Path) -> None:
    capture = Reader(write_seven_scenes(tmp_path, 2), Options())
    for index in (-1, 2):
        with pytest.raises(IndexError):
            capture[index]


def test_few_missing_files_are_broken_frames(tmp_path: Path) -> None:
    write_seven_scenes(tmp_path, 20)
    (tmp_path / "frame-000005.depth.png").unlink()
    capture = Reader(tmp_path, Options())
    assert len(capture) == 20
    with pytest.raises(FrameError, match=r"has no depth image for .*frame-000005\.color\.png"):
        capture[5]
    assert capture[6].color[0, 0, 2] == 60
    np.testing.assert_allclose(capture.pose(5), pose_matrix(5))


def test_many_missing_files_are_a_capture_error(tmp_path: Path) -> None:
    write_seven_scenes(tmp_path, 20)
    for i in (7, 8, 9):
        (tmp_path / f"frame-{i:06d}.color.png").unlink()
    with pytest.raises(CaptureError, match=r"17 color and 20 depth .* frame 7 \(frame-000007\.depth\.png has no col"):
        Reader(tmp_path, Options())
    assert len(Reader(tmp_path, Options(max_broken=0.2))) == 20


def test_no_depth_has_its_own_sentence(tmp_path: Path) -> None:
    write_seven_scenes(tmp_path, 2)
    for path in tmp_path.glob("*.depth.png"):
        path.unlink()
    with pytest.raises(CaptureError, match="holds 2 color images but no depth"):
        Reader(tmp_path, Options())


def test_two_color_images_of_one_frame_are_refused(tmp_path: Path) -> None:
    write_seven_scenes(tmp_path, 2)
    write_image(tmp_path / "frame-000001.color.jpg", color_image(1))
    with pytest.raises(
        CaptureError, match=r"two files of frame 1, frame-000001\.color\.jpg and frame-000001\.color\.p"
    ):
        Reader(tmp_path, Options())


K = np.array([[32.0, 0.0, 15.5], [0.0, 32.0, 11.5], [0.0, 0.0, 1.0]])


@pytest.mark.parametrize(
    ("matrix", "message"),
    [
        (np.where(K == 32, np.nan, K), "NaN or infinite"),
        (np.where(K == 15.5, np.inf, K), "NaN or infinite"),
        (np.where(K == 32, 0, K), "unusable intrinsics"),
        (np.where(K == 32, -32, K), "unusable intrinsics"),
        (K.T, "not a camera matrix"),
        (K[:2], "3 x 3 or 4 x 4"),
        (np.where(K == 15.5, 320, K), "principal point at"),
    ],
)
def test_unusable_intrinsics_name_their_file(tmp_path: Path, matrix, message: str) -> None:
    write_seven_scenes(tmp_path, 1)
    write_matrix(tmp_path / "camera-intrinsics.txt", matrix)
    with pytest.raises(CaptureError, match=message) as caught:
        Reader(tmp_path, Options())
    assert "camera-intrinsics.txt" in str(caught.value)


def test_intrinsics_that_are_no_numbers_name_their_file(tmp_path: Path) -> None:
    write_seven_scenes(tmp_path, 1)
    (tmp_path / "camera-intrinsics.txt").write_text("fx 585\nfy 585\n1")
    with pytest.raises(CaptureError, match=r"camera-intrinsics\.txt must hold"):
        Reader(tmp_path, Options())


def test_one_camera_cannot_have_taken_images_of_two_shapes(tmp_path: Path) -> None:
    write_seven_scenes(tmp_path, 1)
    write_image(tmp_path / "frame-000000.depth.png", np.full((24, 24), 1000, np.uint16))
    with pytest.raises(CaptureError, match="32 x 24 and of 24 x 24"):
        Reader(tmp_path, Options())


def test_the_kitchen_is_a_room_seen_at_rigid_poses() -> None:
    capture = Reader(data_folder() / "7scenes-kitchen", Options())
    assert len(capture) == 1000
    for index in (0, 499, 999):
        frame = capture[index]
        assert frame.color.shape == (480, 640, 3)
        assert frame.depth_m.shape == (480, 640)
        assert 0.5 < np.median(frame.depth_m[frame.depth_m > 0]) < 4.0
        assert frame.intrinsics == Intrinsics(640, 480, 585.0, 585.0, 320.0, 240.0)
        assert capture.pose(index) is not None
