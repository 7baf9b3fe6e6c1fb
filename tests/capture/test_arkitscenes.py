from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from small_captures import color_image, depth_image, pose_matrix, write_image

from freeocc3d.capture import Options, open_capture
from freeocc3d.core.errors import CaptureError, FrameError
from freeocc3d.core.transforms import invert

VIDEO = "47333462"
SIZE = 32, 24
TIMES = 6789.123 + np.array([0.0, 0.1, 0.233, 0.299, 0.4])


def write_scan(root: Path, color: str = "lowres_wide", color_size: tuple[int, int] = SIZE) -> Path:
    lines = []
    for index, time in enumerate(TIMES.tolist()):
        name = f"{VIDEO}_{time:.3f}"
        write_image(root / color / f"{name}.png", color_image(index, color_size))
        write_image(root / "lowres_depth" / f"{name}.png", depth_image(index))
        confidence = np.full(SIZE[::-1], 2, np.uint8)
        confidence[:, -2:] = 0
        write_image(root / "confidence" / f"{name}.png", confidence)
        cameras = root / f"{color}_intrinsics"
        cameras.mkdir(exist_ok=True)
        width, height = color_size
        stated = (width, height, width + index, width + index, (width - 1) / 2, (height - 1) / 2)
        # The times of the released camera files differ from those of their images by up to a millisecond.
        (cameras / f"{VIDEO}_{time + 0.001:.3f}.pincam").write_text(" ".join(map(str, stated)))
        if index != 3:
            T = invert(pose_matrix(index))
            lines.append(" ".join(map(str, [time + 0.0004, *cv2.Rodrigues(T[:3, :3])[0][:, 0].tolist(), *T[:3, 3]])))
    (root / "lowres_wide.traj").write_text("\n".join(lines) + "\n")
    return root


def test_a_scan_comes_back(tmp_path: Path) -> None:
    root = write_scan(tmp_path / VIDEO / f"{VIDEO}_frames")
    for path in (root, root.parent):
        capture = open_capture(path)
        assert capture.format == "arkitscenes"
        assert (len(capture), capture.metric_poses, capture.warnings) == (5, True, ())
        np.testing.assert_allclose(capture.timestamps, TIMES, atol=1e-9)
    for index in range(5):
        frame = capture[index]
        np.testing.assert_array_equal(frame.color, color_image(index))
        wanted = depth_image(index) / 1000
        wanted[:, -2:] = 0
        np.testing.assert_allclose(frame.depth_m, wanted, atol=1e-6)
        assert frame.intrinsics.fx == 32.0 + index
        pose = capture.pose(index)
        assert (pose is None) == (index == 3)
        if pose is not None:
            np.testing.assert_allclose(pose, pose_matrix(index), atol=1e-6)


@pytest.mark.parametrize("color", ["vga_wide", "highres_color"])
def test_larger_color_has_its_own_cameras(tmp_path: Path, color: str) -> None:
    capture = open_capture(write_scan(tmp_path, color, (128, 96)))
    assert (capture[2].color.shape, capture[2].depth_m.shape) == ((24, 32, 3), (24, 32))
    assert capture[2].intrinsics.fx == 130 / 4


def test_color_without_depth_is_left_out_with_a_warning(tmp_path: Path) -> None:
    write_scan(tmp_path)
    (tmp_path / "lowres_depth" / f"{VIDEO}_{TIMES[1]:.3f}.png").unlink()
    (tmp_path / "confidence" / f"{VIDEO}_{TIMES[0]:.3f}.png").unlink()
    capture = open_capture(tmp_path)
    np.testing.assert_allclose(capture.timestamps, TIMES[[0, 2, 3, 4]])
    np.testing.assert_allclose(capture.pose(1), pose_matrix(2), atol=1e-6)
    assert capture[0].depth_m[5, -1] > 0
    assert "has no depth of the same time" in capture.warnings[0].text
    assert len(open_capture(tmp_path, Options(depth=False))) == 5


@pytest.mark.parametrize("text", ["", "1 2 3\n", "time word\n"])
def test_a_file_that_is_no_trajectory_is_refused(tmp_path: Path, text: str) -> None:
    write_scan(tmp_path)
    (tmp_path / "lowres_wide.traj").write_text(text)
    with pytest.raises(CaptureError, match=r"lowres_wide\.traj must hold lines of 7 numbers"):
        open_capture(tmp_path)


def test_without_a_trajectory_there_are_no_poses(tmp_path: Path) -> None:
    write_scan(tmp_path)
    (tmp_path / "lowres_wide.traj").unlink()
    assert open_capture(tmp_path).pose(0) is None


def test_damaged_files_are_refused(tmp_path: Path) -> None:
    write_scan(tmp_path)
    cameras = sorted((tmp_path / "lowres_wide_intrinsics").iterdir())
    cameras[1].write_text("32 24 nan 32 15 11")
    cameras[2].unlink()
    cameras[2].mkdir()
    (tmp_path / "lowres_depth" / f"{VIDEO}_{TIMES[4]:.3f}.png").write_bytes(b"\x89PNG")
    capture = open_capture(tmp_path)
    for index, message in ((1, "must hold six numbers"), (2, "it is a folder"), (4, "not a readable image")):
        with pytest.raises(FrameError, match=message):
            capture[index]
    cameras[0].write_text("")
    with pytest.raises(CaptureError, match="must hold six numbers"):
        open_capture(tmp_path)


def test_depth_of_other_times_is_none(tmp_path: Path) -> None:
    write_scan(tmp_path)
    for path in (tmp_path / "lowres_depth").iterdir():
        path.rename(path.with_name(f"{VIDEO}_{float(path.stem.split('_')[1]) + 50:.3f}.png"))
    with pytest.raises(CaptureError, match="has depth of the same time"):
        open_capture(tmp_path)
