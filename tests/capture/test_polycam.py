from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scans import assert_confidence_counts, plane_scan
from small_captures import color_image, pose_matrix, write_image
from written_phones import polycam_camera, polycam_stamps, write_polycam

from freeocc3d.capture import Options, open_capture
from freeocc3d.capture.readers.polycam import Reader
from freeocc3d.core.errors import CaptureError, FrameError

SIZE, DEPTH_SIZE = (64, 48), (32, 24)
SCAN = plane_scan(4, SIZE, DEPTH_SIZE, unsure=True)
STAMPS = polycam_stamps(SCAN)
SINCE_S = [0, 0.035333, 0.070667, 0.1]


def camera(index: int, **changes: Any) -> dict[str, Any]:
    return polycam_camera(SCAN, index, **changes)


def write_planes(root: Path, prefix: str = "") -> Path:
    return write_polycam(root, SCAN, prefix)


def test_the_folder_above_and_confidence(tmp_path: Path) -> None:
    write_polycam(tmp_path / "keyframes", plane_scan(4, SIZE, SIZE, unsure=True))
    capture = open_capture(tmp_path)
    assert (capture.format, len(capture), capture.warnings) == ("polycam", 4, ())
    frame = capture[2]
    assert_confidence_counts(frame, 2)


def test_color_comes_on_the_pixels_of_the_depth(tmp_path: Path) -> None:
    frame = open_capture(write_planes(tmp_path))[1]
    assert (frame.color.shape, frame.depth_m.shape) == ((24, 32, 3), (24, 32))
    assert (frame.intrinsics.fx, frame.intrinsics.cx) == (32.5, 15.5)


def test_names_may_count_milliseconds(tmp_path: Path) -> None:
    write_planes(tmp_path)
    for folder in ("images", "depth", "confidence", "cameras"):
        for path in sorted((tmp_path / folder).iterdir()):
            path.rename(path.with_name(f"{int(path.stem) // 1000}{path.suffix}"))
    np.testing.assert_allclose(open_capture(tmp_path).timestamps, SINCE_S, atol=1e-3)


def test_corrected_frames_win(tmp_path: Path) -> None:
    write_planes(tmp_path)
    write_planes(tmp_path, "corrected_")
    for stamp in STAMPS:
        write_image(tmp_path / "images" / f"{stamp}.png", np.zeros((48, 64, 3), np.uint8))
        (tmp_path / "cameras" / f"{stamp}.json").write_text(json.dumps(camera(3, t_03=9.0)))
    (tmp_path / "corrected_images" / f"{STAMPS[1]}.png").unlink()
    capture = open_capture(tmp_path)
    assert capture.pose(1) is None  # it is known only in the world of the other cameras
    assert not capture[1].color.any()
    for index in (0, 2, 3):
        np.testing.assert_allclose(capture.pose(index), pose_matrix(index), atol=1e-6)
        assert capture[index].color.any()
    for path in (tmp_path / "cameras", tmp_path / "images"):
        for file in path.iterdir():
            file.unlink()
    assert len(open_capture(tmp_path)) == 3


def test_incomplete_frames_are_left_out_with_a_warning(tmp_path: Path) -> None:
    write_planes(tmp_path)
    (tmp_path / "depth" / f"{STAMPS[1]}.png").unlink()
    (tmp_path / "cameras" / f"{STAMPS[3]}.json").unlink()
    capture = open_capture(tmp_path)
    np.testing.assert_allclose(capture.pose(1), pose_matrix(2), atol=1e-6)
    assert (
        f"2 of the 4 frames of {tmp_path} are left out: the first, {STAMPS[1]}, has no depth"
        in capture.warnings[0].text
    )
    assert len(open_capture(tmp_path, Options(depth=False))) == 3


def test_without_depth_the_message_says_so(tmp_path: Path) -> None:
    write_planes(tmp_path)
    for path in (tmp_path / "depth").iterdir():
        path.unlink()
    with pytest.raises(CaptureError, match=r"holds no depth: .* capture\.depth=false"):
        open_capture(tmp_path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "line 1"),
        ('{"fx": 1}', "lacks 'fy'"),
        (json.dumps(camera(0, cx=-400.0)), "principal point"),
        (json.dumps(camera(0, width=640)), "principal point|640 x 48"),
    ],
)
def test_damaged_cameras_are_refused(tmp_path: Path, text: str, message: str) -> None:
    write_planes(tmp_path)
    file = tmp_path / "cameras" / f"{STAMPS[2]}.json"
    file.write_text(text)
    with pytest.raises(CaptureError, match=message):
        open_capture(tmp_path)
    file.unlink()
    file.mkdir()
    with pytest.raises(CaptureError, match="it is a folder"):
        open_capture(tmp_path)


def test_a_matrix_that_is_no_pose_gives_none(tmp_path: Path) -> None:
    write_planes(tmp_path)
    (tmp_path / "cameras" / f"{STAMPS[2]}.json").write_text(json.dumps(camera(2, t_00=5.0)))
    assert [Reader(tmp_path, Options()).pose(index) is None for index in range(4)] == [False, False, True, False]


def test_damaged_frames_are_broken(tmp_path: Path) -> None:
    write_planes(tmp_path)
    write_image(tmp_path / "images" / f"{STAMPS[1]}.png", color_image(0, (32, 24)))
    (tmp_path / "depth" / f"{STAMPS[2]}.png").write_bytes(b"")
    write_image(tmp_path / "confidence" / f"{STAMPS[3]}.png", color_image(0, DEPTH_SIZE))
    capture = open_capture(tmp_path)
    for index, message in enumerate(("has 32 x 24 pixels", "not a readable image", "8-bit gray"), 1):
        with pytest.raises(FrameError, match=message):
            capture[index]
