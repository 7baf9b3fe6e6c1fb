"""The .sens files are written field by field, after ScanNet's sensorData.h: no Python package writes the format."""

from __future__ import annotations

import os
import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from small_captures import camera_matrix, color_image, depth_image, pose_matrix

from freeocc3d.capture import Options, open_capture
from freeocc3d.capture.readers.scannet_sens import Reader
from freeocc3d.core.errors import CaptureError, FrameError

SIZE = 32, 24


def write_sens(
    path: Path,
    count: int = 4,
    color_size: tuple[int, int] = SIZE,
    kinds: tuple[int, int] = (1, 1),
    T_rig_depth: NDArray[np.float64] | None = None,
    stated: int | None = None,
    sizes_of_content: tuple[tuple[int, int], tuple[int, int]] | None = None,
) -> Path:
    """kinds: packing of color (0 plain, 1 PNG, 2 JPEG) and depth (0 plain, 1 zlib).  sizes_of_content: of color and
    depth, if the header states others."""
    content = sizes_of_content or (color_size, SIZE)
    matrices = [_wide(camera_matrix(color_size)), np.eye(4), _wide(camera_matrix()), np.eye(4)]
    if T_rig_depth is not None:
        matrices[3] = T_rig_depth
    out = bytearray(struct.pack("<IQ", 4, 9) + b"Structure")
    for matrix in matrices:
        out += matrix.astype("<f4").tobytes()
    out += struct.pack("<2i4IfQ", *kinds, *color_size, *SIZE, 1000.0, count if stated is None else stated)
    for index in range(count):
        color = pack_color(color_image(index, content[0]), kinds[0])
        depth = depth_image(index, size=content[1]).astype("<u2").tobytes()
        depth = zlib.compress(depth) if kinds[1] == 1 else depth
        pose = np.full((4, 4), -np.inf) if index == 2 else pose_matrix(index)
        out += pose.astype("<f4").tobytes() + struct.pack("<4Q", 33_333 * index, 7, len(color), len(depth))
        out += color + depth
    out += struct.pack("<Q", 0)  # no inertial measurements
    path.write_bytes(out)
    return path


def pack_color(image: NDArray[np.uint8], kind: int) -> bytes:
    if kind == 0:
        return image.tobytes()
    return cv2.imencode(".png" if kind == 1 else ".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR))[1].tobytes()


def _wide(K: NDArray[np.float64]) -> NDArray[np.float64]:
    out = np.eye(4)
    out[:3, :3] = K[:3, :3]
    return out


@pytest.mark.parametrize("kinds", [(1, 1), (0, 0)])
def test_a_recording_comes_back(tmp_path: Path, kinds: tuple[int, int]) -> None:
    capture = open_capture(write_sens(tmp_path / "scene0000_00.sens", kinds=kinds))
    assert capture.format == "scannet_sens"
    assert (len(capture), capture.has_depth, capture.metric_poses, capture.intrinsics_known) == (4, True, True, True)
    np.testing.assert_allclose(capture.timestamps, 0.033333 * np.arange(4), atol=1e-9)
    for index in range(4):
        frame = capture[index]
        np.testing.assert_array_equal(frame.color, color_image(index))
        np.testing.assert_allclose(frame.depth_m, depth_image(index) / 1000, atol=1e-6)
        assert frame.intrinsics.fx == pytest.approx(camera_matrix()[0, 0])
    assert capture.pose(2) is None
    np.testing.assert_allclose(capture.pose(3), pose_matrix(3), atol=1e-6)
    assert capture.warnings == ()


def test_jpeg_color_of_another_size_comes_on_the_pixels_of_the_depth(tmp_path: Path) -> None:
    capture = open_capture(write_sens(tmp_path / "a.sens", color_size=(64, 48), kinds=(2, 1)))
    assert capture[1].color.shape == (24, 32, 3)
    assert np.abs(capture[1].color.astype(int) - color_image(1)).max() < 12
    only_color = Reader(tmp_path / "a.sens", Options(depth=False))
    assert (only_color[1].color.shape, only_color.has_depth) == ((48, 64, 3), False)


def test_extrinsics_move_the_depth(tmp_path: Path) -> None:
    T_rig_depth = np.eye(4)
    T_rig_depth[0, 3] = 0.2
    capture = open_capture(write_sens(tmp_path / "a.sens", T_rig_depth=T_rig_depth))
    still = open_capture(write_sens(tmp_path / "b.sens"))
    assert np.argmax(capture[0].depth_m[12] > 0) > np.argmax(still[0].depth_m[12] > 0) + 1


def test_the_folder_of_a_recording_is_read_unless_it_was_exported(tmp_path: Path) -> None:
    write_sens(tmp_path / "scene0000_00.sens")
    assert open_capture(tmp_path).format == "scannet_sens"
    (tmp_path / "color").mkdir()
    assert not Reader.recognizes(tmp_path)


def test_of_a_file_that_is_cut_off_the_whole_frames_are_used(tmp_path: Path) -> None:
    path = write_sens(tmp_path / "a.sens")
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
    path = write_sens(tmp_path / "a.sens")
    os.truncate(path, size)
    with pytest.raises(CaptureError, match="its header is cut off"):
        open_capture(path)
    assert not Reader.recognizes(path.rename(tmp_path / "scan"))


def test_a_recording_is_recognized_by_its_content(tmp_path: Path) -> None:
    assert open_capture(write_sens(tmp_path / "scan.bin")).format == "scannet_sens"


def test_other_versions_and_packings_are_refused(tmp_path: Path) -> None:
    path = write_sens(tmp_path / "a.sens", kinds=(2, 2))
    with pytest.raises(CaptureError, match=r"not read \(color 2, depth 2\)"):
        Reader(path, Options())
    data = bytearray(path.read_bytes())
    data[0] = 3
    path.write_bytes(data)
    with pytest.raises(CaptureError, match="it states version 3"):
        Reader(path, Options())


def test_frames_that_unpack_to_another_size_are_broken(tmp_path: Path) -> None:
    capture = Reader(write_sens(tmp_path / "a.sens", 1, sizes_of_content=((40, 24), (10_000, 10_000))), Options())
    with pytest.raises(FrameError, match="has 40 x 24 pixels"):
        capture.stored_color(0)
    with pytest.raises(FrameError, match="does not have 32 x 24 pixels"):
        capture.stored_depth(0)


def test_a_count_of_frames_that_no_file_holds_takes_no_memory(tmp_path: Path) -> None:
    assert len(open_capture(write_sens(tmp_path / "a.sens", 3, stated=1 << 62))) == 3


def test_a_folder_in_place_of_the_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.sens").mkdir()
    with pytest.raises(CaptureError, match="is a folder"):
        open_capture(tmp_path / "a.sens", Options(format="scannet_sens"))
