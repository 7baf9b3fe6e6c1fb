from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scans import Scan, plane_scan
from small_captures import color_image, depth_image, pose_matrix
from written_recordings import write_sens

from freeocc3d.capture import Options, open_capture
from freeocc3d.capture.readers.scannet_sens import Reader
from freeocc3d.core.errors import CaptureError, FrameError

SIZE = 32, 24


def write_planes(path: Path, count: int = 4, color_size: tuple[int, int] = SIZE, **more: Any) -> Path:
    return write_sens(path, plane_scan(count, color_size, SIZE), **more)


def four_frames() -> Scan:
    """Frame 2 is lost."""
    scan = plane_scan(4)
    return replace(scan, T_world_cam=[*scan.T_world_cam[:2], np.full((4, 4), np.nan), scan.T_world_cam[3]])


def test_plain_images_and_a_lost_frame_come_back(tmp_path: Path) -> None:
    capture = open_capture(write_sens(tmp_path / "scene0000_00.sens", four_frames(), kinds=(0, 0)))
    np.testing.assert_array_equal(capture[2].color, color_image(2))
    np.testing.assert_allclose(capture[2].depth_m, depth_image(2) / 1000, atol=1e-6)
    assert capture.pose(2) is None
    np.testing.assert_allclose(capture.pose(3), pose_matrix(3), atol=1e-6)


def test_jpeg_color_of_another_size_comes_on_the_pixels_of_the_depth(tmp_path: Path) -> None:
    capture = open_capture(write_planes(tmp_path / "a.sens", color_size=(64, 48), kinds=(2, 1)))
    assert capture[1].color.shape == (24, 32, 3)
    assert np.abs(capture[1].color.astype(int) - color_image(1)).max() < 12
    only_color = Reader(tmp_path / "a.sens", Options(depth=False))
    assert (only_color[1].color.shape, only_color.has_depth) == ((48, 64, 3), False)


def test_extrinsics_move_the_depth(tmp_path: Path) -> None:
    T_rig_depth = np.eye(4)
    T_rig_depth[0, 3] = 0.2
    capture = open_capture(write_planes(tmp_path / "a.sens", T_rig_depth=T_rig_depth))
    still = open_capture(write_planes(tmp_path / "b.sens"))
    assert np.argmax(capture[0].depth_m[12] > 0) > np.argmax(still[0].depth_m[12] > 0) + 1


def test_the_folder_of_a_recording_is_read_unless_it_was_exported(tmp_path: Path) -> None:
    write_planes(tmp_path / "scene0000_00.sens")
    assert open_capture(tmp_path).format == "scannet_sens"
    (tmp_path / "color").mkdir()
    assert not Reader.recognizes(tmp_path)


def test_of_a_file_that_is_cut_off_the_whole_frames_are_used(tmp_path: Path) -> None:
    path = write_planes(tmp_path / "a.sens")
    size = path.stat().st_size
    os.truncate(path, size - 100)
    capture = open_capture(path)
    assert len(capture) == 3
    assert "it states 4 frames, and 3 are whole" in capture.warnings[0].text
    capture[2]
    os.truncate(path, 400)
    with pytest.raises(CaptureError, match="holds no whole frame: it states 4"):
        open_capture(path)


@pytest.mark.parametrize("size", [0, 3, 12, 100, 290])
def test_a_cut_off_header_is_refused(tmp_path: Path, size: int) -> None:
    path = write_planes(tmp_path / "a.sens")
    os.truncate(path, size)
    with pytest.raises(CaptureError, match="its header is cut off"):
        open_capture(path)
    assert not Reader.recognizes(path.rename(tmp_path / "scan"))


def test_a_recording_is_recognized_by_its_content(tmp_path: Path) -> None:
    assert open_capture(write_planes(tmp_path / "scan.bin")).format == "scannet_sens"


def test_other_versions_and_packings_are_refused(tmp_path: Path) -> None:
    path = write_planes(tmp_path / "a.sens", kinds=(2, 2))
    with pytest.raises(CaptureError, match=r"not read \(color 2, depth 2\)"):
        Reader(path, Options())
    data = bytearray(path.read_bytes())
    data[0] = 3
    path.write_bytes(data)
    with pytest.raises(CaptureError, match="it states version 3"):
        Reader(path, Options())


def test_frames_that_unpack_to_another_size_are_broken(tmp_path: Path) -> None:
    scan = plane_scan(1, (40, 24), (3000, 3000))
    capture = Reader(write_sens(tmp_path / "a.sens", scan, sizes=(SIZE, SIZE)), Options())
    with pytest.raises(FrameError, match="has 40 x 24 pixels"):
        capture.stored_color(0)
    with pytest.raises(FrameError, match="does not have 32 x 24 pixels"):
        capture.stored_depth(0)


def test_a_count_of_frames_that_no_file_holds_takes_no_memory(tmp_path: Path) -> None:
    assert len(open_capture(write_planes(tmp_path / "a.sens", 3, stated=1 << 62))) == 3


def test_a_folder_in_place_of_the_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.sens").mkdir()
    with pytest.raises(CaptureError, match="is a folder"):
        open_capture(tmp_path / "a.sens", Options(format="scannet_sens"))
