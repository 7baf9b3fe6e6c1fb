from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scans import plane_scan
from small_captures import write_matrix
from written_folders import write_bundlefusion, write_info

from freeocc3d.capture import open_capture
from freeocc3d.capture.base import Options
from freeocc3d.core.errors import CaptureError, FrameError


def write_planes(folder: Path, count: int, shift_m: float = 0.0, **more: str) -> Path:
    write_bundlefusion(folder, plane_scan(count), **more)
    T_rig_depth = np.eye(4)
    T_rig_depth[0, 3] = shift_m
    if shift_m:
        write_info(folder / "info.txt", plane_scan(count), T_rig_depth)
    return folder


def test_the_folder_of_the_images_is_the_same_capture(tmp_path: Path) -> None:
    write_planes(tmp_path, 2, images="sequence", info="_info.txt", depth="pgm")
    assert open_capture(tmp_path / "sequence").format == "bundlefusion"


def test_depth_of_another_place_is_registered(tmp_path: Path) -> None:
    """A plane at 2 m, seen by a depth camera 0.25 m to the right of color, lands 4 pixels farther to the right."""
    capture = open_capture(write_planes(tmp_path, 1, shift_m=0.25))
    measured = np.flatnonzero(capture[0].depth_m[12])
    assert measured[0] == pytest.approx(1 + 0.25 / 2.0 * 32, abs=1)


def test_without_an_info_file_it_is_seven_scenes(tmp_path: Path) -> None:
    write_planes(tmp_path, 1)
    (tmp_path / "info.txt").unlink()
    assert open_capture(tmp_path).format == "seven_scenes"


def test_a_lost_frame_has_no_pose_and_a_missing_image_is_a_broken_frame(tmp_path: Path) -> None:
    write_planes(tmp_path, 20)
    write_matrix(tmp_path / "frame-000001.pose.txt", np.full((4, 4), -np.inf))
    (tmp_path / "frame-000002.depth.png").unlink()
    capture = open_capture(tmp_path)
    assert capture.pose(1) is None
    with pytest.raises(FrameError, match=r"no depth image for .*frame-000002"):
        capture[2]


@pytest.mark.parametrize("text", ["", "m_depthShift = 1000\n", "m_calibrationColorIntrinsic = 1 2 3\n", "\0\1"])
def test_an_info_file_without_cameras(tmp_path: Path, text: str) -> None:
    write_planes(tmp_path, 1)
    (tmp_path / "info.txt").write_text(text)
    with pytest.raises(CaptureError, match=r"info\.txt states no camera"):
        open_capture(tmp_path)
    assert open_capture(tmp_path, Options(focal=30.0)).intrinsics_known


def test_extrinsics_that_are_no_transform(tmp_path: Path) -> None:
    write_planes(tmp_path, 1)
    write_info(tmp_path / "info.txt", plane_scan(1), 2 * np.eye(4))
    with pytest.raises(CaptureError, match=r"info\.txt.*m_calibrationDepthExtrinsic is no rigid transform"):
        open_capture(tmp_path)
