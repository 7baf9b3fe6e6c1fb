from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from small_captures import SIZE, camera_matrix, color_image, depth_image, pose_matrix, write_image, write_matrix

from freeocc3d.capture import open_capture
from freeocc3d.capture.base import Options
from freeocc3d.capture.readers.bundlefusion import Reader
from freeocc3d.core.errors import CaptureError, FrameError


def write_info(path: Path, color_size: tuple[int, int], T_rig_depth: np.ndarray, units: float = 1000.0) -> None:
    def numbers(matrix: np.ndarray) -> str:
        whole = np.eye(4)
        whole[: len(matrix), : len(matrix)] = matrix
        return " ".join(map(str, whole.reshape(16).tolist()))

    path.write_text(
        "m_versionNumber = 4\nm_sensorName = StructureSensor\n"
        f"m_colorWidth = {color_size[0]}\nm_colorHeight = {color_size[1]}\n"
        f"m_depthWidth = {SIZE[0]}\nm_depthHeight = {SIZE[1]}\nm_depthShift = {units:g}\n"
        f"m_calibrationColorIntrinsic = {numbers(camera_matrix(color_size))} \n"
        f"m_calibrationColorExtrinsic = {numbers(np.eye(4))} \n"
        f"m_calibrationDepthIntrinsic = {numbers(camera_matrix())} \n"
        f"m_calibrationDepthExtrinsic = {numbers(T_rig_depth)} \n"
        "m_frames.size = 3\n"
    )


def write_bundlefusion(
    folder: Path, n: int, images: str = "", info: str = "info.txt", depth: str = "png", shift_m: float = 0.0
) -> Path:
    for i in range(n):
        name = folder / images / f"frame-{i:06d}"
        write_image(name.with_name(f"{name.name}.color.png"), color_image(i))
        stored = depth_image(i)
        if depth == "pgm":
            name.with_name(f"{name.name}.depth.pgm").write_bytes(
                b"P5\n%d %d\n65535\n" % SIZE + stored.astype(">u2").tobytes()
            )
        else:
            write_image(name.with_name(f"{name.name}.depth.{depth}"), stored)
        write_matrix(name.with_name(f"{name.name}.pose.txt"), pose_matrix(i))
    T_rig_depth = np.eye(4)
    T_rig_depth[0, 3] = shift_m
    write_info(folder / images / info, SIZE, T_rig_depth)
    return folder


@pytest.mark.parametrize(("images", "info", "depth"), [("", "info.txt", "png"), ("sequence", "_info.txt", "pgm")])
def test_a_round_trip(tmp_path: Path, images: str, info: str, depth: str) -> None:
    """As BundleFusion has it, and as 3RScan."""
    capture = open_capture(write_bundlefusion(tmp_path, 3, images, info, depth))
    assert isinstance(capture, Reader)
    assert (len(capture), capture.units_per_meter, capture.intrinsics_known) == (3, 1000.0, True)
    for i in range(3):
        frame = capture[i]
        np.testing.assert_array_equal(frame.color, color_image(i))
        np.testing.assert_allclose(frame.depth_m, depth_image(i) / 1000, atol=1e-6)
        np.testing.assert_allclose(frame.intrinsics.matrix, camera_matrix())
        np.testing.assert_allclose(capture.pose(i), pose_matrix(i), atol=1e-6)


def test_the_folder_of_the_images_is_the_same_capture(tmp_path: Path) -> None:
    write_bundlefusion(tmp_path, 2, "sequence", "_info.txt", "pgm")
    assert open_capture(tmp_path / "sequence").format == "bundlefusion"


def test_depth_of_another_place_is_registered(tmp_path: Path) -> None:
    """A plane at 2 m, seen by a depth camera 0.25 m to the right of color, lands 4 pixels farther to the right."""
    capture = open_capture(write_bundlefusion(tmp_path, 1, shift_m=0.25))
    measured = np.flatnonzero(capture[0].depth_m[12])
    assert measured[0] == pytest.approx(1 + 0.25 / 2.0 * 32, abs=1)


def test_without_an_info_file_it_is_seven_scenes(tmp_path: Path) -> None:
    write_bundlefusion(tmp_path, 1)
    (tmp_path / "info.txt").unlink()
    assert open_capture(tmp_path).format == "seven_scenes"


def test_a_lost_frame_has_no_pose_and_a_missing_image_is_a_broken_frame(tmp_path: Path) -> None:
    write_bundlefusion(tmp_path, 20)
    write_matrix(tmp_path / "frame-000001.pose.txt", np.full((4, 4), -np.inf))
    (tmp_path / "frame-000002.depth.png").unlink()
    capture = open_capture(tmp_path)
    assert capture.pose(1) is None
    with pytest.raises(FrameError, match=r"no depth image for .*frame-000002"):
        capture[2]


@pytest.mark.parametrize("text", ["", "m_depthShift = 1000\n", "m_calibrationColorIntrinsic = 1 2 3\n", "\0\1"])
def test_an_info_file_without_cameras(tmp_path: Path, text: str) -> None:
    write_bundlefusion(tmp_path, 1)
    (tmp_path / "info.txt").write_text(text)
    with pytest.raises(CaptureError, match=r"info\.txt states no camera"):
        open_capture(tmp_path)
    assert open_capture(tmp_path, Options(focal=30.0)).intrinsics_known


def test_extrinsics_that_are_no_transform(tmp_path: Path) -> None:
    write_bundlefusion(tmp_path, 1)
    write_info(tmp_path / "info.txt", SIZE, 2 * np.eye(4))
    with pytest.raises(CaptureError, match=r"info\.txt.*m_calibrationDepthExtrinsic is no rigid transform"):
        open_capture(tmp_path)
