from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scans import plane_scan
from small_captures import depth_image, pose_matrix
from written_phones import ARKIT_VIDEO as VIDEO
from written_phones import write_arkitscenes

from freeocc3d.capture import Options, open_capture
from freeocc3d.core.errors import CaptureError, FrameError

SIZE = 32, 24
TIMES = 6789.123 + np.array([0.0, 0.1, 0.233, 0.299, 0.4])


def write_planes(root: Path, color: str = "lowres_wide", size: tuple[int, int] = SIZE) -> Path:
    """Frame 3 has no pose."""
    write_arkitscenes(root, plane_scan(5, size, SIZE, unsure=True, times=TIMES.tolist()), color)
    lines = (root / "lowres_wide.traj").read_text().splitlines(keepends=True)
    (root / "lowres_wide.traj").write_text("".join(lines[:3] + lines[4:]))
    return root


def test_the_folder_above_confidence_and_a_frame_without_a_pose(tmp_path: Path) -> None:
    write_planes(tmp_path / VIDEO / f"{VIDEO}_frames")
    capture = open_capture(tmp_path / VIDEO)
    assert (capture.format, len(capture), capture.warnings) == ("arkitscenes", 5, ())
    wanted = depth_image(3) / 1000
    wanted[:, -2:] = 0
    np.testing.assert_allclose(capture[3].depth_m, wanted, atol=1e-6)
    assert capture.pose(3) is None
    np.testing.assert_allclose(capture.pose(4), pose_matrix(4), atol=1e-6)


@pytest.mark.parametrize("color", ["vga_wide", "highres_color"])
def test_larger_color_has_its_own_cameras(tmp_path: Path, color: str) -> None:
    capture = open_capture(write_planes(tmp_path, color, (128, 96)))
    assert (capture[2].color.shape, capture[2].depth_m.shape) == ((24, 32, 3), (24, 32))
    assert capture[2].intrinsics.fx == 130 / 4


def test_color_without_depth_is_left_out_with_a_warning(tmp_path: Path) -> None:
    write_planes(tmp_path)
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
    write_planes(tmp_path)
    (tmp_path / "lowres_wide.traj").write_text(text)
    with pytest.raises(CaptureError, match=r"lowres_wide\.traj must hold lines of 7 numbers"):
        open_capture(tmp_path)


def test_without_a_trajectory_there_are_no_poses(tmp_path: Path) -> None:
    write_planes(tmp_path)
    (tmp_path / "lowres_wide.traj").unlink()
    assert open_capture(tmp_path).pose(0) is None


def test_damaged_files_are_refused(tmp_path: Path) -> None:
    write_planes(tmp_path)
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
    write_planes(tmp_path)
    for path in (tmp_path / "lowres_depth").iterdir():
        path.rename(path.with_name(f"{VIDEO}_{float(path.stem.split('_')[1]) + 50:.3f}.png"))
    with pytest.raises(CaptureError, match="has depth of the same time"):
        open_capture(tmp_path)
