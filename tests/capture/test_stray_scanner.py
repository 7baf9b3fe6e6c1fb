from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from scans import assert_confidence_counts, plane_scan
from small_captures import color_image, depth_image, pose_matrix, write_image, write_matrix
from written_phones import STRAY_COLUMNS, write_lossless, write_odometry, write_stray

from freeocc3d.capture import Options, open_capture
from freeocc3d.capture.readers.stray_scanner import Reader
from freeocc3d.core.errors import CaptureError, FrameError

SIZE, DEPTH_SIZE = (128, 96), (32, 24)


def write_planes(
    root: Path, count: int = 6, depth_size: tuple[int, int] = DEPTH_SIZE, newer: bool = True, video: bool = True
) -> Path:
    """Without a camera of frame 1, and with another in camera_matrix.csv."""
    write_stray(root, plane_scan(count, SIZE, depth_size, unsure=True), newer, video)
    odometry = root / "odometry.csv"
    odometry.write_text(odometry.read_text().replace(", 129.0, 129.0, 63.5, 47.5, , ", ", , , , , , "))
    (root / "camera_matrix.csv").write_text("110.0, 0.0, 63.5\n0.0, 110.0, 47.5\n0.0, 0.0, 1.0\n")
    return root


def test_a_frame_without_a_camera_has_the_usual_one_and_confidence_is_an_uncertainty(tmp_path: Path) -> None:
    capture = open_capture(write_planes(tmp_path, 3, SIZE, video=False))
    assert [capture[index].intrinsics.fx for index in range(3)] == [128.0, 110.0, 130.0]
    frame = capture[2]
    assert_confidence_counts(frame, 2)


def test_color_comes_on_the_pixels_of_the_depth_and_cameras_follow(tmp_path: Path) -> None:
    capture = open_capture(write_planes(tmp_path, newer=False))
    frame = capture[3]
    assert (frame.color.shape, frame.depth_m.shape) == ((24, 32, 3), (24, 32))
    assert np.abs(frame.color.astype(int) - color_image(3, DEPTH_SIZE)).max() < 16
    assert (frame.intrinsics.fx, frame.intrinsics.cx) == (27.5, 15.5)


def test_without_depth_color_keeps_its_size(tmp_path: Path) -> None:
    write_planes(tmp_path)
    capture = Reader(tmp_path, Options(depth=False))
    assert (capture.has_depth, capture[2].color.shape, capture[2].intrinsics.fx) == (False, (96, 128, 3), 130.0)
    assert Reader(tmp_path, Options(depth=False, max_size=64))[2].color.shape == (48, 64, 3)


def test_cameras_for_the_usual_size_fit_a_smaller_video(tmp_path: Path) -> None:
    write_planes(tmp_path, newer=False)
    write_matrix(tmp_path / "camera_matrix.csv", np.array([[1650.0, 0, 959.5], [0, 1650.0, 719.5], [0, 0, 1]]))
    assert open_capture(tmp_path)[0].intrinsics.fx == pytest.approx(27.5)


def test_frames_are_paired_by_number(tmp_path: Path) -> None:
    write_planes(tmp_path)
    (tmp_path / "depth" / "000000.png").unlink()
    (tmp_path / "confidence" / "000003.png").unlink()
    write_image(tmp_path / "depth" / "000006.png", depth_image(6, size=DEPTH_SIZE))
    write_odometry(tmp_path / "odometry.csv", plane_scan(4, SIZE))
    capture = open_capture(tmp_path)
    assert len(capture) == 5
    assert f"2 of the 7 frames of {tmp_path} are left out: the first, 0, has no depth" in capture.warnings[0].text
    np.testing.assert_allclose(capture.pose(2), pose_matrix(3), atol=1e-6)
    assert capture[2].depth_sigma_m is None
    np.testing.assert_allclose(capture[4].depth_m.max(), 2.05, atol=1e-6)
    assert capture.pose(3) is None
    assert capture[3].intrinsics.fx == pytest.approx(27.5)
    np.testing.assert_allclose(np.diff(capture.timestamps), 1 / 60, atol=1e-6)  # the video's: two frames have no line


def test_depth_may_be_arrays(tmp_path: Path) -> None:
    write_planes(tmp_path)
    for index in range(6):
        (tmp_path / "depth" / f"{index:06d}.png").unlink()
        np.save(tmp_path / "depth" / f"{index:06d}.npy", depth_image(index, size=DEPTH_SIZE))
    np.testing.assert_allclose(open_capture(tmp_path)[2].depth_m.max(), 2.02, atol=1e-6)
    for index in range(6):
        np.save(tmp_path / "depth" / f"{index:06d}.npy", depth_image(index, size=DEPTH_SIZE) / np.float32(1000))
    np.testing.assert_allclose(open_capture(tmp_path)[2].depth_m.max(), 2.02, atol=1e-6)


@pytest.mark.parametrize("rotation", [90, 180])
def test_a_video_that_a_player_turns_stays_as_depth_is(tmp_path: Path, rotation: int) -> None:
    write_planes(tmp_path, 3, SIZE)
    write_lossless(tmp_path / "rgb.mp4", [color_image(index, SIZE) for index in range(3)], rotation=rotation)
    np.testing.assert_array_equal(open_capture(tmp_path)[1].color, color_image(1, SIZE))


def test_threads_get_the_frames_that_they_ask_for(tmp_path: Path) -> None:
    capture = open_capture(write_planes(tmp_path, 12, depth_size=SIZE))
    order = np.random.default_rng(0).permutation(12).tolist() * 2
    with ThreadPoolExecutor(4) as pool:
        for index, frame in zip(order, pool.map(capture.__getitem__, order), strict=True):
            np.testing.assert_array_equal(frame.color, color_image(index, SIZE))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "names of its columns"),
        ("1.0, 0, 0, 0, 0, 0, 0, 0, 1\n", "names of its columns"),
        (f"{STRAY_COLUMNS}\n1.0, 000000, 0, 0, 0, 0, 0, 0, 1\n2.0, 000001, here, 0, 0, 0, 0, 0, 1\n", "in line 3"),
    ],
)
def test_damaged_odometry_is_refused(tmp_path: Path, text: str, message: str) -> None:
    write_planes(tmp_path)
    (tmp_path / "odometry.csv").write_text(text)
    with pytest.raises(CaptureError, match=message):
        open_capture(tmp_path)


def test_a_line_that_is_cut_off_has_no_pose(tmp_path: Path) -> None:
    write_planes(tmp_path)
    file = tmp_path / "odometry.csv"
    file.write_bytes(b"\xef\xbb\xbf" + file.read_bytes().replace(b"\n", b"\r\n")[:-100])
    capture = open_capture(tmp_path)
    assert capture.pose(4) is not None
    assert capture.pose(5) is None


def test_missing_and_damaged_files_are_told(tmp_path: Path) -> None:
    write_planes(tmp_path)
    (tmp_path / "depth" / "000002.png").write_bytes(b"")
    write_image(tmp_path / "depth" / "000003.png", depth_image(3, size=(16, 12)))
    write_image(tmp_path / "confidence" / "000004.png", depth_image(3))
    capture = open_capture(tmp_path)
    for index, message in ((2, "not a readable image"), (3, "has 16 x 12 pixels"), (4, "8-bit gray")):
        with pytest.raises(FrameError, match=message):
            capture[index]
    os.truncate(tmp_path / "rgb.mp4", 100)
    with pytest.raises(CaptureError, match=r"rgb\.mp4 is not a readable video"):
        open_capture(tmp_path)
    (tmp_path / "rgb.mp4").unlink()
    with pytest.raises(CaptureError, match=r"has no rgb\.mp4"):
        open_capture(tmp_path)
    (tmp_path / "rgb.mp4").mkdir()
    with pytest.raises(CaptureError, match="it is a folder"):
        open_capture(tmp_path)
