from __future__ import annotations

import os
import struct
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import lzfse
import numpy as np
import pytest
from numpy.typing import NDArray
from scans import Scan, plane_scan
from small_captures import color_image, pose_matrix
from written_phones import record3d_members, write_members, write_record3d_exr

from freeocc3d.capture import Options, open_capture
from freeocc3d.capture.files import packed_files
from freeocc3d.capture.images.lzfse_blocks import lzfse_size, unpack_lzfse
from freeocc3d.capture.readers import record3d
from freeocc3d.capture.readers.record3d import Reader
from freeocc3d.core.errors import CaptureError, FrameError

SIZE = 48, 64
"""Width and height of the depth; phones are held upright."""


def scan_of(count: int, color_size: tuple[int, int] = SIZE) -> Scan:
    return plane_scan(count, color_size, SIZE, unsure=True)


def depth_of(index: int) -> NDArray[np.float32]:
    depth = scan_of(12).depth_m[index].copy()
    depth[0, :9] = np.nan
    return depth


def members(count: int, color_size: tuple[int, int] = SIZE, **changes: Any) -> dict[str, bytes]:
    scan = scan_of(count, color_size)
    return record3d_members(replace(scan, depth_m=[depth_of(index) for index in range(count)]), **changes)


def test_nan_is_no_depth_and_confidence_an_uncertainty(tmp_path: Path) -> None:
    capture = open_capture(write_members(tmp_path / "scan.r3d", members(12)))
    frame = capture[10]
    np.testing.assert_array_equal(frame.color, color_image(10, SIZE))
    wanted = np.nan_to_num(depth_of(10))
    wanted[:, -2:] = 0
    np.testing.assert_array_equal(frame.depth_m, wanted)
    assert frame.depth_sigma_m is not None
    assert (frame.depth_sigma_m[1, -5] / frame.depth_sigma_m[1, 5]) == pytest.approx(2.0)


def test_larger_color_comes_on_the_pixels_of_the_depth(tmp_path: Path) -> None:
    files = members(2, (96, 128), perFrameIntrinsicCoeffs=None, dw=None, dh=None)
    frame = open_capture(write_members(tmp_path / "scan.r3d", files, zipfile.ZIP_DEFLATED))[1]
    assert (frame.color.shape, frame.depth_m.shape) == ((64, 48, 3), (64, 48))
    assert frame.intrinsics.fx == pytest.approx(SIZE[0])
    assert frame.intrinsics.cx == pytest.approx((SIZE[0] - 1) / 2)


def test_k_is_column_major_and_for_the_stated_size(tmp_path: Path) -> None:
    K = [100.0, 0, 0, 0, 110.0, 0, 40.0, 70.0, 1]
    files = members(2, w=96, h=128, K=K, perFrameIntrinsicCoeffs=[])
    camera = open_capture(write_members(tmp_path / "scan.r3d", files))[0].intrinsics
    np.testing.assert_allclose((camera.fx, camera.fy, camera.cx, camera.cy), (50, 55, 19.75, 34.75))


def test_an_export_as_exr_is_found_below_its_folder(tmp_path: Path) -> None:
    write_record3d_exr(tmp_path / "EXR_RGBD", replace(scan_of(3), depth_m=[depth_of(index) for index in range(3)]))
    capture = open_capture(tmp_path)
    assert (capture.format, len(capture)) == ("record3d", 3)
    np.testing.assert_array_equal(capture[2].depth_m, np.nan_to_num(depth_of(2)))


def test_frames_without_depth_are_left_out_with_a_warning(tmp_path: Path) -> None:
    files = members(4)
    del files["rgbd/2.depth"], files["rgbd/0.conf"]
    capture = open_capture(write_members(tmp_path / "scan.r3d", files))
    assert len(capture) == 3
    np.testing.assert_allclose(capture.pose(2), pose_matrix(3), atol=1e-6)
    assert "the first, 2, has no depth" in capture.warnings[0].text
    assert capture[0].depth_sigma_m is None
    assert len(open_capture(tmp_path / "scan.r3d", Options(depth=False))) == 4


def test_a_capture_without_depth_says_so(tmp_path: Path) -> None:
    files = {name: data for name, data in members(2).items() if not name.endswith(".depth")}
    with pytest.raises(CaptureError, match=r"holds no depth for its color: .* capture\.depth=false"):
        open_capture(write_members(tmp_path / "scan.r3d", files))


def test_times_and_poses_may_be_absent(tmp_path: Path) -> None:
    files = members(3, frameTimestamps=None, poses=[])
    capture = open_capture(write_members(tmp_path / "scan.r3d", files))
    np.testing.assert_allclose(capture.timestamps, np.arange(3) / 60)
    assert capture.pose(1) is None


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"w": 0}, "'w' has a number that is not > 0"),
        ({"K": [1, 2]}, "'K': Expected"),
        ({"poses": [[1, 2]]}, "poses"),
        ({"perFrameIntrinsicCoeffs": [], "K": [1e-9, 0, 0, 0, 1e-9, 0, 5, 5, 1]}, "unusable intrinsics"),
    ],
)
def test_damaged_metadata_is_refused(tmp_path: Path, changes: dict[str, Any], message: str) -> None:
    with pytest.raises(CaptureError, match=message):
        open_capture(write_members(tmp_path / "scan.r3d", members(1, **changes)))


def test_damaged_files_are_refused_in_one_sentence(tmp_path: Path) -> None:
    path = write_members(tmp_path / "scan.r3d", members(3))
    os.truncate(path, path.stat().st_size // 2)
    with pytest.raises(CaptureError, match="is cut off, or no zip archive"):
        open_capture(path)
    path.write_bytes(b"")
    with pytest.raises(CaptureError, match="is no capture of Record3D"):
        open_capture(path)
    (tmp_path / "folder" / "metadata").mkdir(parents=True)
    (tmp_path / "folder" / "rgbd").mkdir()
    with pytest.raises(CaptureError, match="metadata"):
        open_capture(tmp_path / "folder")


def test_damaged_frames_are_broken(tmp_path: Path) -> None:
    files = members(5)
    files["rgbd/1.depth"] = files["rgbd/1.depth"][:-30]
    files["rgbd/2.depth"] = lzfse.compress(bytes(400))
    files["rgbd/3.conf"] = lzfse.compress(bytes(1 << 24))
    files["rgbd/4.jpg"] = files["rgbd/4.jpg"][:-40]
    capture = open_capture(write_members(tmp_path / "scan.r3d", files))
    for index, message in enumerate(("is cut off", "holds 400 bytes", "unpacks to 16777216 bytes", "is cut off"), 1):
        with pytest.raises(FrameError, match=message):
            capture[index]
    capture[0]


def test_a_bomb_of_a_zip_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(record3d, "IMAGE_BYTES", 8 << 20)
    files = {**members(1), "rgbd/0.jpg": bytes(16 << 20)}
    capture_file = write_members(tmp_path / "scan.r3d", files, zipfile.ZIP_DEFLATED)
    assert capture_file.stat().st_size < 1 << 20
    with pytest.raises(CaptureError, match="unpacks to more than the 8 MB"):
        open_capture(capture_file)


def test_too_many_members_are_refused_before_they_are_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_members(tmp_path / "scan.r3d", members(4))
    monkeypatch.setattr(packed_files, "MOST_MEMBERS", 12)
    monkeypatch.setattr(zipfile, "ZipFile", None)
    with pytest.raises(CaptureError, match="holds more than 12 members"):
        open_capture(path)


def test_another_archive_is_no_capture(tmp_path: Path) -> None:
    path = write_members(tmp_path / "other.zip", {"metadata": b"{}", "readme.txt": b"text"})
    assert not Reader.recognizes(path)


@pytest.mark.parametrize("count", [0, 5, 1000, 49_152, 1 << 20])
def test_sizes_of_blocks_are_known_before_unpacking(count: int) -> None:
    for data in (bytes(count), np.random.default_rng(0).integers(0, 255, count, np.uint8).tobytes()):
        packed = lzfse.compress(data)
        assert lzfse_size(packed, Path("a")) == count
        if count:
            assert unpack_lzfse(packed, Path("a"), count) == data


def test_blocks_of_more_matches_than_bytes_are_refused() -> None:
    packed = bytearray(lzfse.compress(np.random.default_rng(0).integers(0, 9, 50_000, np.uint8).tobytes()))
    assert packed[:4] == b"bvx2"
    struct.pack_into("<I", packed, 4, 16)  # it states 16 bytes for thousands of matches
    with pytest.raises(FrameError, match="not packed with LZFSE"):
        unpack_lzfse(bytes(packed), Path("a"), 1 << 30)
