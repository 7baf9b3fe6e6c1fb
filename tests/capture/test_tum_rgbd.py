from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scans import plane_scan, pose_line
from small_captures import color_image, data_folder, depth_image, pose_matrix, write_image
from written_folders import LATE_S, write_tum

from freeocc3d.capture import open_capture
from freeocc3d.capture.base import Options
from freeocc3d.capture.readers.tum_rgbd import Reader
from freeocc3d.core.errors import CaptureError
from freeocc3d.core.transforms import back_project, invert, project, transform
from freeocc3d.core.types import Intrinsics

START = 1305031102.175304


def write_planes(
    folder: Path, n: int, lists: bool = True, recording: str = "room", size: tuple[int, int] = (32, 24)
) -> list[float]:
    """n frames at 30 Hz with poses; the times of color. lists: write rgb.txt and depth.txt."""
    times = [round(START + i / 30, 6) for i in range(n)]
    write_tum(folder, plane_scan(n, size, times=times), "rgb depth" if lists else "", recording)
    return times


def test_the_unit_and_the_lens_are_those_of_the_recording_that_comments_name(tmp_path: Path) -> None:
    write_planes(tmp_path, 1, recording="freiburg1_desk", size=(640, 480))
    capture = open_capture(tmp_path)
    assert isinstance(capture, Reader)
    assert (capture.units_per_meter, capture.intrinsics_known) == (5000.0, True)
    lens = capture.rig(0).color
    assert (lens.camera.fx, lens.distortion[0]) == (517.3, 0.2624)
    assert capture.rig(0).depth == lens, "depth is registered to the distorted color"


@pytest.mark.parametrize("recording", ["freiburg4_desk", "room"])
def test_nothing_is_assumed_of_other_recordings(tmp_path: Path, recording: str) -> None:
    write_planes(tmp_path, 1, recording=recording)
    capture = Reader(tmp_path, Options())
    assert (capture.units_stated, capture.intrinsics_known) == (False, False)


@pytest.mark.parametrize("depth_first", [True, False])
@pytest.mark.parametrize("name", ["associations.txt", "associate.txt", "fr1_association.txt"])
def test_associations_of_either_order(tmp_path: Path, depth_first: bool, name: str) -> None:
    times = write_planes(tmp_path, 4, lists=False)
    lines = []
    for i, time in enumerate(times):
        pair = [f"{time:.6f} rgb\\{time:.6f}.png", f"{time + LATE_S:.6f} depth/{time + LATE_S:.6f}.png"]
        lines.append(" ".join(pair[::-1] if depth_first else pair) + ("\r\n" if i % 2 else "\n"))
    (tmp_path / name).write_text("".join(lines[::-1]))
    capture = open_capture(tmp_path, Options(depth_scale=5000.0))
    assert capture.format == "tum_rgbd"
    np.testing.assert_array_equal(capture.timestamps, times)
    np.testing.assert_array_equal(capture[3].color, color_image(3))
    assert capture[3].depth_m.max() == pytest.approx(2.03, abs=1e-4)
    np.testing.assert_allclose(capture.pose(3), pose_matrix(3), atol=1e-6)


def test_names_that_do_not_say_depth_are_looked_into(tmp_path: Path) -> None:
    for i in range(2):
        write_image(tmp_path / "a" / f"{i}.png", depth_image(i))
        write_image(tmp_path / "b" / f"{i}.png", color_image(i))
    (tmp_path / "associations.txt").write_text("0.1 a/0.png 0.1 b/0.png\n0.2 a/1.png 0.2 b/1.png\n")
    np.testing.assert_array_equal(open_capture(tmp_path)[1].color, color_image(1))


def test_times_that_contradict_the_names_are_left_out(tmp_path: Path) -> None:
    lines = []
    for i, time in enumerate((0.005, 0.0118, 0.0165, 0.0305, 0.0067)):
        write_image(tmp_path / "rgb" / f"rgb{i}.png", color_image(i))
        write_image(tmp_path / "depths" / f"depth{i}.png", depth_image(i))
        lines.append(f"{time} rgb/rgb{i}.png {time} depths/depth{i}.png\n")
    (tmp_path / "associations.txt").write_text("".join(lines))
    capture = open_capture(tmp_path)
    np.testing.assert_array_equal(capture.timestamps, np.arange(5))
    assert [int(capture[i].color[0, 0, 2]) for i in range(5)] == [0, 10, 20, 30, 40]


def test_names_without_trailing_zeros_sort_as_numbers(tmp_path: Path) -> None:
    for i, name in enumerate(("999.9", "1000", "1000.1", "1000.15", "1000.2")):
        if i != 1:
            write_image(tmp_path / "rgb" / f"{name}.png", color_image(i))
            write_image(tmp_path / "depth" / f"{name}.png", depth_image(i))
    capture = open_capture(tmp_path)
    assert [int(capture[i].color[0, 0, 2]) for i in range(4)] == [0, 20, 30, 40]
    np.testing.assert_allclose(capture.timestamps, [999.9, 1000.1, 1000.15, 1000.2])


def test_poses_are_interpolated_between_denser_true_ones(tmp_path: Path) -> None:
    times = write_planes(tmp_path, 3)
    turn = np.eye(4)
    dense = []
    for step in range(-4, 12):
        angle = np.deg2rad(3.0 * step)
        turn[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
        turn[0, 3] = 0.1 * step
        dense.append(pose_line(START + 0.01 * step, turn))
    (tmp_path / "groundtruth.txt").write_text("# ground truth\n" + "".join(dense))
    T = Reader(tmp_path, Options()).pose(1)
    assert T is not None
    step = (times[1] - START) / 0.01
    assert T[0, 3] == pytest.approx(0.1 * step, abs=1e-5)
    assert np.rad2deg(np.arctan2(T[1, 0], T[0, 0])) == pytest.approx(3.0 * step, abs=1e-3)


def test_a_frame_far_from_all_true_poses_has_none(tmp_path: Path) -> None:
    times = write_planes(tmp_path, 6)
    (tmp_path / "groundtruth.txt").write_text(pose_line(times[0] + 0.019, pose_matrix(0)))
    capture = Reader(tmp_path, Options())
    assert [capture.pose(i) is None for i in range(6)] == [False, False, True, True, True, True]


def test_images_without_a_partner_are_left_out_with_a_warning(tmp_path: Path) -> None:
    times = write_planes(tmp_path, 10)
    (tmp_path / "depth" / f"{times[4] + LATE_S:.6f}.png").unlink()
    capture = Reader(tmp_path, Options())
    assert len(capture) == 9
    assert {notice.code for notice in capture.warnings} == {"images-left-out"}
    assert any(f"{times[4] + LATE_S:.6f}.png" in notice.text for notice in capture.warnings)


def test_lists_of_other_times_say_so(tmp_path: Path) -> None:
    write_planes(tmp_path, 4)
    lines = (tmp_path / "depth.txt").read_text().replace("\n1305", "\n1405")
    (tmp_path / "depth.txt").write_text(lines)
    with pytest.raises(CaptureError, match=r"0 of the 4 images .*rgb\.txt and 4 .*depth\.txt have times"):
        Reader(tmp_path, Options())


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "lists no images"),
        ("1.0 rgb/a.png 1.0\n", "lists no images"),
        ("1.0 rgb/a.png 1.0 depth/a.png\n2.0 rgb/b.png\n", "Line 2 of .*time path time path"),
        ("1.0 rgb/a.png 1.0 depth/a.png\nnan x 1 y\n", "Line 2"),
        ("1.0 rgb/a.png 1.0 depth/a.png\n", "None of the 1 color images"),
        ("1.0 ../../rgb/a.png 1.0 /etc/passwd\n", "None of the 1 color images"),
    ],
)
def test_bad_associations(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "associations.txt").write_text(text)
    with pytest.raises(CaptureError, match=message):
        open_capture(tmp_path)


def test_a_list_alone_is_told(tmp_path: Path) -> None:
    write_planes(tmp_path, 2)
    (tmp_path / "depth.txt").unlink()
    (tmp_path / "depth").rename(tmp_path / "other")
    with pytest.raises(CaptureError, match=r"needs rgb\.txt and depth\.txt"):
        open_capture(tmp_path, Options(format="tum_rgbd"))


def test_color_alone_needs_no_depth_list(tmp_path: Path) -> None:
    write_planes(tmp_path, 3)
    (tmp_path / "depth.txt").write_text("")
    capture = Reader(tmp_path, Options(depth=False))
    assert len(capture) == 3
    assert not capture[2].depth_m.any()


def test_icl_nuims_poses_agree_with_its_depth() -> None:
    """Its depth, warped by the poses, meets the next image; by the poses as stored it is twice as far off."""
    capture = open_capture(data_folder() / "wild" / "icl-nuim", Options(intrinsics=(481.2, 480.0, 319.5, 239.5)))
    assert capture.format == "tum_rgbd"
    mirror = np.diag((1.0, -1.0, 1.0, 1.0))
    first, last = capture.pose(0), capture.pose(5)
    assert first is not None
    assert last is not None
    T = invert(last) @ first
    assert isinstance(capture, Reader)
    capture.units_per_meter = 5000.0
    right, stored = (color_difference(capture, motion) for motion in (T, mirror @ T @ mirror))
    assert right < 0.6 * stored


def test_the_poses_of_icl_nuim_have_y_up(tmp_path: Path) -> None:
    """Beside associations with depth first and numbers as times, or in a file of its suffix."""
    up = np.diag((1.0, -1.0, 1.0, 1.0))
    for i in range(3):
        write_image(tmp_path / "rgb" / f"{i}.png", color_image(i))
        write_image(tmp_path / "depth" / f"{i}.png", depth_image(i))
    lines = "".join(pose_line(i, up @ pose_matrix(i) @ up) for i in range(3))
    (tmp_path / "livingRoom0.gt.freiburg").write_text(lines)
    np.testing.assert_allclose(open_capture(tmp_path).pose(2), pose_matrix(2), atol=1e-6)
    (tmp_path / "livingRoom0.gt.freiburg").rename(tmp_path / "groundtruth.txt")
    (tmp_path / "associations.txt").write_text("".join(f"{i} depth/{i}.png {i} rgb/{i}.png\n" for i in range(3)))
    capture = open_capture(tmp_path)
    assert capture.format == "tum_rgbd"
    np.testing.assert_allclose(capture.pose(2), pose_matrix(2), atol=1e-6)
    np.testing.assert_array_equal(capture.timestamps, np.arange(3))


def color_difference(capture: Reader, T_last_first: np.ndarray) -> float:
    first, last = capture[0], capture[5]
    camera: Intrinsics = first.intrinsics
    v, u = np.mgrid[: camera.height : 4, : camera.width : 4]
    depth_m = first.depth_m[::4, ::4]
    points = back_project(np.stack((u, v), axis=-1), depth_m, camera)[depth_m > 0]
    pixels, _ = project(transform(T_last_first, points.astype(np.float64)), camera)
    column, row = pixels.round().astype(int).T
    inside = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
    seen = first.color[::4, ::4][depth_m > 0][inside].astype(float)
    return float(np.abs(last.color[row[inside], column[inside]] - seen).mean())
