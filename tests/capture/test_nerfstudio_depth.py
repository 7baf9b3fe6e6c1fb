"""Depth of transforms.json, under the keys of nerfstudio, instant-ngp and NeRFCapture."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import pytest
from numpy.typing import NDArray
from posed_captures import write_nerfstudio
from small_captures import SIZE, color_image, depth_image, write_image

from freeocc3d.capture import Options, open_capture
from freeocc3d.capture.rgbd_frames import RgbdFrames
from freeocc3d.core.errors import CaptureError, FrameError


def change(folder: Path, change_content: Callable[[dict[str, Any]], None]) -> Path:
    file = folder / "transforms.json"
    content = json.loads(file.read_text())
    change_content(content)
    file.write_text(json.dumps(content))
    return folder


def write_depths(folder: Path, units: float, size: tuple[int, int] = SIZE) -> Path:
    for path in (folder / "depth").iterdir():
        write_image(path, depth_image(int(path.stem.split("_")[1]), units, size))
    return folder


def test_nerfstudios_unit_is_that_of_the_file_or_of_the_frame(tmp_path: Path) -> None:
    write_depths(write_nerfstudio(tmp_path, 3, depth_unit_scale_factor=0.00025, integer_depth_scale=9.0), 4000)
    write_image(tmp_path / "depth" / "frame_1.png", np.where(depth_image(1) > 0, depth_image(1), 65535))

    def state_another(content: dict[str, Any]) -> None:
        frame = next(frame for frame in content["frames"] if "frame_1" in frame["file_path"])
        frame["depth_unit_scale_factor"] = 0.001

    capture = open_capture(change(tmp_path, state_another))
    for index in range(3):
        np.testing.assert_allclose(capture[index].depth_m[:, 1:], 2 + 0.01 * index, atol=1e-6)
        assert not capture[index].depth_m[:, 0].any()
    given = open_capture(tmp_path, Options(depth_scale=4000))
    np.testing.assert_allclose(given[1].depth_m[:, 1:], 2.01 / 4, atol=1e-6)


def test_a_unit_that_is_not_stated_is_unknown(tmp_path: Path) -> None:
    capture = open_capture(write_nerfstudio(tmp_path, 2, integer_depth_scale=0.0))
    assert isinstance(capture, RgbdFrames)
    assert not capture.units_stated
    np.testing.assert_allclose(capture[1].depth_m[:, 1:], 2.01, atol=1e-6)


def write_array(path: Path, depth: NDArray[np.float32]) -> None:
    if path.suffix == ".npy":
        np.save(path, depth)
        return
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, {"Z": depth}).write(str(path))


@pytest.mark.parametrize("suffix", [".npy", ".exr"])
@pytest.mark.parametrize("stated", [{}, {"depth_unit_scale_factor": 1.0}, {"integer_depth_scale": 0.001}])
def test_depth_as_floats(tmp_path: Path, suffix: str, stated: dict[str, float]) -> None:
    write_nerfstudio(tmp_path, 2, **stated)
    for path in sorted((tmp_path / "depth").iterdir()):
        path.unlink()
        index = int(path.stem.split("_")[1])
        write_array(path.with_suffix(suffix), (depth_image(index) / 1000).astype(np.float32))

    def rename(content: dict[str, Any]) -> None:
        for frame in content["frames"]:
            frame["depth_file_path"] = frame["depth_file_path"].replace(".png", suffix)

    np.testing.assert_allclose(open_capture(change(tmp_path, rename))[1].depth_m[:, 1:], 2.01, atol=1e-6)


def test_frames_have_the_pixels_of_smaller_depth(tmp_path: Path) -> None:
    capture = open_capture(write_depths(write_nerfstudio(tmp_path, 2), 1000, (16, 12)))
    frame = capture[1]
    assert (frame.color.shape, frame.depth_m.shape) == ((12, 16, 3), (12, 16))
    np.testing.assert_array_equal(frame.color[3, 5], np.rint(color_image(1)[6:8, 10:12].mean(axis=(0, 1))))
    assert (frame.intrinsics.fx, frame.intrinsics.cx) == (16.0, 7.5)
    np.testing.assert_allclose(frame.depth_m, depth_image(1, size=(16, 12)) / 1000, atol=1e-6)


def test_frames_are_reduced_to_the_largest_size(tmp_path: Path) -> None:
    frame = open_capture(write_nerfstudio(tmp_path, 2), Options(max_size=16))[1]
    assert (frame.color.shape, frame.depth_m.shape, frame.intrinsics.fx) == ((12, 16, 3), (12, 16), 16.0)
    np.testing.assert_allclose(frame.depth_m[:, 1:], 2.01, atol=1e-6)


@pytest.mark.parametrize("model", ["OPENCV", "OPENCV_FISHEYE"])
def test_color_and_depth_of_a_lens_are_undistorted_together(tmp_path: Path, model: str) -> None:
    write_nerfstudio(tmp_path, 2, camera_model=model, k1=-0.1)
    step = np.full(SIZE[::-1], 1000, np.uint16)
    step[:, SIZE[0] // 2 :] = 3000
    color = np.zeros((*SIZE[::-1], 3), np.uint8)
    color[:, SIZE[0] // 2 :] = 255
    write_image(tmp_path / "depth" / "frame_0.png", step)
    write_image(tmp_path / "images" / "frame_0.png", color)
    frame = open_capture(tmp_path)[0]
    assert set(np.unique(frame.depth_m.round(3)).tolist()) == {1.0, 3.0}
    assert ((frame.depth_m > 2) == (frame.color[..., 0] > 127)).mean() > 0.97


def test_frames_of_several_sizes_have_depth_of_theirs(tmp_path: Path) -> None:
    write_nerfstudio(tmp_path, 2)
    write_image(tmp_path / "images" / "frame_0.png", color_image(0, (24, 32)))
    write_image(tmp_path / "depth" / "frame_0.png", depth_image(0, size=(12, 16)))

    def turn(content: dict[str, Any]) -> None:
        frame = next(frame for frame in content["frames"] if "frame_0" in frame["file_path"])
        frame.update({"w": 24, "h": 32, "cx": 12.0, "cy": 16.0})

    capture = open_capture(change(tmp_path, turn))
    assert [capture[index].depth_m.shape for index in (0, 1)] == [(16, 12), (24, 32)]


def test_depth_of_another_view_is_refused_and_of_another_size_broken(tmp_path: Path) -> None:
    write_nerfstudio(tmp_path, 3)
    write_image(tmp_path / "depth" / "frame_1.png", depth_image(1, size=(16, 12)))
    with pytest.raises(FrameError, match="has 16 x 12 pixels"):
        open_capture(tmp_path)[1]
    write_image(tmp_path / "depth" / "frame_0.png", depth_image(0, size=(20, 20)))
    with pytest.raises(CaptureError, match="cannot have taken images of 32 x 24 and of 20 x 20"):
        open_capture(tmp_path)
