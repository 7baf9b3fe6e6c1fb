"""``capture.depth=false``: every reader gives color alone, and opens no depth file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from small_captures import SIZE, camera_matrix, color_image, write_replica, write_scannet, write_seven_scenes

from freeocc3d.capture import Options, open_capture
from freeocc3d.capture.cameras.camera_files import USUAL_FOCAL
from freeocc3d.core.errors import CaptureError, ConfigError, TrackingError
from freeocc3d.pipeline import run

COLOR_ALONE = Options(depth=False)


def remove_depth(folder: Path) -> None:
    for path in [*folder.rglob("*depth*.png"), *folder.rglob("depth/*.png")]:
        path.unlink()


@pytest.mark.parametrize("write", [write_seven_scenes, write_replica, write_scannet])
def test_depth_is_neither_needed_nor_read(tmp_path: Path, write) -> None:
    with_depth = open_capture(write(tmp_path, 3))
    expected = with_depth[1]
    remove_depth(tmp_path)
    capture = open_capture(tmp_path, COLOR_ALONE)
    assert with_depth.has_depth
    assert not capture.has_depth
    frame = capture[1]
    np.testing.assert_array_equal(frame.color, expected.color)
    assert frame.intrinsics == expected.intrinsics
    assert frame.depth_m.shape == expected.depth_m.shape
    assert frame.depth_m.dtype == np.float32
    assert not frame.depth_m.any()
    assert capture.raw_depth(1) is None
    assert (len(capture), capture.name(2), capture[2].index) == (3, with_depth.name(2), 2)
    np.testing.assert_array_equal(capture.pose(1), with_depth.pose(1))


@pytest.mark.parametrize("write", [write_seven_scenes, write_replica, write_scannet])
def test_broken_depth_does_no_harm(tmp_path: Path, write) -> None:
    write(tmp_path, 2)
    for path in tmp_path.rglob("*depth*/*.png"):
        path.write_bytes(b"no image")
    for path in tmp_path.rglob("*depth*.png"):
        path.write_bytes(b"no image")
    assert not open_capture(tmp_path, COLOR_ALONE)[0].depth_m.any()


@pytest.mark.parametrize("write", [write_seven_scenes, write_replica, write_scannet])
def test_a_folder_without_depth_names_the_option(tmp_path: Path, write) -> None:
    write(tmp_path, 2)
    remove_depth(tmp_path)
    with pytest.raises(CaptureError, match=r"2 color images but no depth: .*capture\.depth=false"):
        open_capture(tmp_path)


def test_the_pixel_grid_is_the_color_cameras_own(tmp_path: Path) -> None:
    size = 2 * SIZE[0], 2 * SIZE[1]
    write_scannet(tmp_path, 1, color_size=size)
    assert open_capture(tmp_path)[0].color.shape == (SIZE[1], SIZE[0], 3)
    frame = open_capture(tmp_path, COLOR_ALONE)[0]
    np.testing.assert_array_equal(frame.color, color_image(0, size))
    np.testing.assert_allclose(frame.intrinsics.matrix, camera_matrix(size))


@pytest.mark.parametrize(
    ("write", "files"), [(write_replica, ["cam_params.json"]), (write_scannet, ["intrinsic/intrinsic_color.txt"])]
)
def test_an_unknown_camera_is_guessed_and_said_to_be(tmp_path: Path, write, files: list[str]) -> None:
    write(tmp_path, 1)
    assert open_capture(tmp_path, COLOR_ALONE).intrinsics_known
    for file in files:
        (tmp_path / file).unlink()
    capture = open_capture(tmp_path, COLOR_ALONE)
    assert not capture.intrinsics_known
    assert capture[0].intrinsics.fx == pytest.approx(USUAL_FOCAL * SIZE[0])
    given = open_capture(tmp_path, Options(depth=False, intrinsics=(30.0, 31.0, 16.0, 12.0)))
    assert given.intrinsics_known
    assert given[0].intrinsics.fy == 31.0


def test_what_seven_scenes_states_is_the_depth_camera(tmp_path: Path) -> None:
    write_seven_scenes(tmp_path, 1)
    assert open_capture(tmp_path).intrinsics_known
    assert not open_capture(tmp_path, COLOR_ALONE).intrinsics_known


def test_the_built_in_room_has_the_same_color() -> None:
    small = {"synthetic": {"width": 32, "height": 24}}
    frame = open_capture("builtin:room", COLOR_ALONE, small)[3]
    assert not frame.depth_m.any()
    np.testing.assert_array_equal(frame.color, open_capture("builtin:room", Options(), small)[3].color)


def test_a_scale_is_refused_where_depth_says_it() -> None:
    with pytest.raises(ConfigError, match=r"capture\.scale is for scans without depth, but builtin:room has depth"):
        open_capture("builtin:room", Options(scale=2.0))
    assert not open_capture("builtin:room", Options(scale=2.0, depth=False)).has_depth


@pytest.mark.parametrize("backend", ["rgbd", "odometry"])
def test_a_tracker_that_needs_depth_says_so(tmp_path: Path, backend: str) -> None:
    scan = write_seven_scenes(tmp_path / "scan", 3)
    settings = {"capture": {"depth": False}, "tracking": {"backend": backend}}
    with pytest.raises(TrackingError, match=rf"backend={backend} needs depth, .*leave tracking\.backend at auto"):
        run.reconstruct(scan, tmp_path / "map", settings)
    assert not list(tmp_path.glob("map*"))
