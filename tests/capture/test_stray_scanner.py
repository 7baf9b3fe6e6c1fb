from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest
from numpy.typing import NDArray
from small_captures import color_image, depth_image, pose_matrix, write_image, write_matrix

from freeocc3d.capture import Options, open_capture
from freeocc3d.capture.readers.stray_scanner import Reader
from freeocc3d.core.errors import CaptureError, FrameError
from freeocc3d.core.transforms import rotations_to_quats

SIZE, DEPTH_SIZE = (128, 96), (32, 24)
HEADER = "timestamp, frame, x, y, z, qx, qy, qz, qw"
NEWER = f"{HEADER}, fx, fy, cx, cy, distortion_center_x, distortion_center_y"


def write_lossless(path: Path, images: Sequence[NDArray[np.uint8]]) -> Path:
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264rgb", rate=60, options={"qp": "0", "preset": "ultrafast"})
        stream.height, stream.width = images[0].shape[:2]
        stream.pix_fmt = "rgb24"
        stream.time_base = stream.codec_context.time_base = Fraction(1, 60)
        for number, image in enumerate(images):
            frame = av.VideoFrame.from_ndarray(image, format="rgb24")
            frame.pts, frame.time_base = number, Fraction(1, 60)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path


def time_of(index: int) -> float:
    return 12_345.678901 + index / 60 + 0.002 * (index % 3)


def write_odometry(path: Path, count: int, newer: bool = True) -> None:
    lines = [NEWER if newer else HEADER]
    for index in range(count):
        T = pose_matrix(index)
        w, x, y, z = rotations_to_quats(T[None, :3, :3])[0].tolist()
        line = f"{time_of(index):.6f}, {index:06d}, " + ", ".join(f"{v:.9f}" for v in (*T[:3, 3], x, y, z, w))
        blank = ", , , , , , " if index == 1 else f", {120 + index}, {120 + index}, 63.5, 47.5, , "
        lines.append(line + (blank if newer else ""))
    path.write_text("\n".join(lines) + "\n")


def write_stray(
    root: Path, count: int = 6, depth_size: tuple[int, int] = DEPTH_SIZE, newer: bool = True, video: bool = True
) -> Path:
    root.mkdir(exist_ok=True)
    images = [color_image(index, SIZE) for index in range(count)]
    if video:
        write_lossless(root / "rgb.mp4", images)
    for index in range(count):
        if not video:
            write_image(root / "rgb" / f"{index:06d}.png", images[index])
        write_image(root / "depth" / f"{index:06d}.png", depth_image(index, size=depth_size))
        confidence = np.full(depth_size[::-1], 2, np.uint8)
        confidence[:, -8:], confidence[:, -2:] = 1, 0
        write_image(root / "confidence" / f"{index:06d}.png", confidence)
    write_odometry(root / "odometry.csv", count, newer)
    (root / "camera_matrix.csv").write_text("110.0, 0.0, 63.5\n0.0, 110.0, 47.5\n0.0, 0.0, 1.0\n")
    return root


@pytest.mark.parametrize("video", [True, False])
def test_a_scan_comes_back(tmp_path: Path, video: bool) -> None:
    capture = open_capture(write_stray(tmp_path, depth_size=SIZE, video=video))
    assert capture.format == "stray_scanner"
    assert (len(capture), capture.metric_poses, capture.intrinsics_known, capture.warnings) == (6, True, True, ())
    np.testing.assert_allclose(capture.timestamps, [time_of(index) for index in range(6)], atol=1e-6)
    for index in (0, 1, 5, 2):
        frame = capture[index]
        np.testing.assert_array_equal(frame.color, color_image(index, SIZE))
        wanted = depth_image(index, size=SIZE) / 1000
        wanted[:, -2:] = 0
        np.testing.assert_allclose(frame.depth_m, wanted, atol=1e-6)
        np.testing.assert_allclose(capture.pose(index), pose_matrix(index), atol=1e-6)
        assert frame.intrinsics.fx == (110.0 if index == 1 else 120.0 + index)
        assert frame.depth_sigma_m is not None
        assert frame.depth_sigma_m[1, -5] == pytest.approx(2 * frame.depth_sigma_m[1, 5])


def test_color_comes_on_the_pixels_of_the_depth_and_cameras_follow(tmp_path: Path) -> None:
    capture = open_capture(write_stray(tmp_path, newer=False))
    frame = capture[3]
    assert (frame.color.shape, frame.depth_m.shape) == ((24, 32, 3), (24, 32))
    assert np.abs(frame.color.astype(int) - color_image(3, DEPTH_SIZE)).max() < 16
    assert (frame.intrinsics.fx, frame.intrinsics.cx) == (27.5, 15.5)


def test_without_depth_color_keeps_its_size(tmp_path: Path) -> None:
    write_stray(tmp_path)
    capture = Reader(tmp_path, Options(depth=False))
    assert (capture.has_depth, capture[2].color.shape, capture[2].intrinsics.fx) == (False, (96, 128, 3), 122.0)
    assert Reader(tmp_path, Options(depth=False, max_size=64))[2].color.shape == (48, 64, 3)


def test_cameras_for_the_usual_size_fit_a_smaller_video(tmp_path: Path) -> None:
    write_stray(tmp_path, newer=False)
    write_matrix(tmp_path / "camera_matrix.csv", np.array([[1650.0, 0, 959.5], [0, 1650.0, 719.5], [0, 0, 1]]))
    assert open_capture(tmp_path)[0].intrinsics.fx == pytest.approx(27.5)


def test_frames_are_paired_by_number(tmp_path: Path) -> None:
    write_stray(tmp_path)
    (tmp_path / "depth" / "000000.png").unlink()
    (tmp_path / "confidence" / "000003.png").unlink()
    write_image(tmp_path / "depth" / "000006.png", depth_image(6, size=DEPTH_SIZE))
    write_odometry(tmp_path / "odometry.csv", 4)
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
    write_stray(tmp_path)
    for index in range(6):
        (tmp_path / "depth" / f"{index:06d}.png").unlink()
        np.save(tmp_path / "depth" / f"{index:06d}.npy", depth_image(index, size=DEPTH_SIZE))
    np.testing.assert_allclose(open_capture(tmp_path)[2].depth_m.max(), 2.02, atol=1e-6)
    for index in range(6):
        np.save(tmp_path / "depth" / f"{index:06d}.npy", depth_image(index, size=DEPTH_SIZE) / np.float32(1000))
    np.testing.assert_allclose(open_capture(tmp_path)[2].depth_m.max(), 2.02, atol=1e-6)


def test_threads_get_the_frames_that_they_ask_for(tmp_path: Path) -> None:
    capture = open_capture(write_stray(tmp_path, 12, depth_size=SIZE))
    order = np.random.default_rng(0).permutation(12).tolist() * 2
    with ThreadPoolExecutor(4) as pool:
        for index, frame in zip(order, pool.map(capture.__getitem__, order), strict=True):
            np.testing.assert_array_equal(frame.color, color_image(index, SIZE))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "names of its columns"),
        ("1.0, 0, 0, 0, 0, 0, 0, 0, 1\n", "names of its columns"),
        (f"{HEADER}\n1.0, 000000, 0, 0, 0, 0, 0, 0, 1\n2.0, 000001, here, 0, 0, 0, 0, 0, 1\n", "in line 3"),
    ],
)
def test_damaged_odometry_is_refused(tmp_path: Path, text: str, message: str) -> None:
    write_stray(tmp_path)
    (tmp_path / "odometry.csv").write_text(text)
    with pytest.raises(CaptureError, match=message):
        open_capture(tmp_path)


def test_a_line_that_is_cut_off_has_no_pose(tmp_path: Path) -> None:
    write_stray(tmp_path)
    file = tmp_path / "odometry.csv"
    file.write_bytes(b"\xef\xbb\xbf" + file.read_bytes().replace(b"\n", b"\r\n")[:-100])
    capture = open_capture(tmp_path)
    assert capture.pose(4) is not None
    assert capture.pose(5) is None


def test_missing_and_damaged_files_are_told(tmp_path: Path) -> None:
    write_stray(tmp_path)
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
