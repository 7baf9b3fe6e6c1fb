from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from small_captures import class_image, color_image, data_folder, pose_matrix, write_image, write_replica

from freeocc3d.capture.base import Options
from freeocc3d.capture.readers.replica import Reader
from freeocc3d.core.errors import CaptureError, FrameError
from freeocc3d.core.types import Intrinsics


@pytest.mark.parametrize("beside", [False, True])
def test_a_frame_has_rgb_meters_and_intrinsics(tmp_path: Path, beside: bool) -> None:
    capture = Reader(write_replica(tmp_path / "office0", 3, beside=beside), Options())
    frame = capture[1]
    np.testing.assert_array_equal(frame.color, color_image(1))
    np.testing.assert_allclose(frame.depth_m[:, 1:], 2.01, atol=1e-4)
    assert not frame.depth_m[:, 0].any()
    assert frame.intrinsics == Intrinsics(32, 24, 32.0, 32.0, 15.5, 11.5)
    np.testing.assert_allclose(capture.pose(2), pose_matrix(2))
    assert (capture.classes, capture.labels(0)) == ((), None)


def test_the_scale_of_the_file_and_of_the_options(tmp_path: Path) -> None:
    write_replica(tmp_path, 1, scale=1000.0)
    assert Reader(tmp_path, Options())[0].depth_m.max() == pytest.approx(2.0)
    assert Reader(tmp_path, Options(depth_scale=4000.0))[0].depth_m.max() == pytest.approx(0.5)


def test_class_images_index_the_names(tmp_path: Path) -> None:
    capture = Reader(write_replica(tmp_path, 2, classes=True), Options())
    assert capture.classes == ("nothing", "sofa", "lamp")
    np.testing.assert_array_equal(capture.labels(1), class_image())


def test_a_missing_class_image_is_none_and_an_unnamed_class_an_error(tmp_path: Path) -> None:
    capture = Reader(write_replica(tmp_path, 2, classes=True), Options())
    (tmp_path / "semantic_class" / "semantic_class_0.png").unlink()
    write_image(tmp_path / "semantic_class" / "semantic_class_1.png", np.full((24, 32), 3, np.uint8))
    assert capture.labels(0) is None
    with pytest.raises(FrameError, match=r"semantic_class_1\.png holds class 3, but only 3"):
        capture.labels(1)


def test_a_pose_free_run_opens_neither_poses_nor_class_images(tmp_path: Path) -> None:
    write_replica(tmp_path, 1, classes=True)
    (tmp_path / "traj.txt").write_text("opened")
    (tmp_path / "semantic_class" / "semantic_class_0.png").write_text("opened")
    capture = Reader(tmp_path, Options())
    assert capture[0].color.shape == (24, 32, 3)
    with pytest.raises(CaptureError, match=r"traj\.txt must hold 16 numbers"):
        capture.pose(0)
    with pytest.raises(FrameError, match="semantic_class_0"):
        capture.labels(0)


def test_poses_are_optional(tmp_path: Path) -> None:
    assert Reader(write_replica(tmp_path, 1, poses=False), Options()).pose(0) is None


def test_a_pose_that_is_not_rigid_is_none(tmp_path: Path) -> None:
    write_replica(tmp_path, 2)
    rows = np.array([np.full(16, np.nan), pose_matrix(1).reshape(16)])
    np.savetxt(tmp_path / "traj.txt", rows)
    capture = Reader(tmp_path, Options())
    assert capture.pose(0) is None
    np.testing.assert_allclose(capture.pose(1), pose_matrix(1))


def test_frames_that_were_taken_out_keep_their_poses(tmp_path: Path) -> None:
    write_replica(tmp_path, 5)
    for kind in ("frame", "depth"):
        (tmp_path / "results" / f"{kind}000001.png").unlink()
    capture = Reader(tmp_path, Options())
    assert len(capture) == 4
    np.testing.assert_allclose(capture.pose(1), pose_matrix(2))
    np.testing.assert_array_equal(capture[1].color, color_image(2))


def test_fewer_poses_than_frames_cannot_be_assigned(tmp_path: Path) -> None:
    write_replica(tmp_path, 5)
    np.savetxt(tmp_path / "traj.txt", np.array([pose_matrix(i).reshape(16) for i in range(3)]))
    with pytest.raises(CaptureError, match="3 poses for 5 frames"):
        Reader(tmp_path, Options()).pose(0)


def write_parameters(folder: Path, **changes: object) -> None:
    camera = {"w": 32, "h": 24, "fx": 32.0, "fy": 32.0, "cx": 15.5, "cy": 11.5, "scale": 6553.5, **changes}
    (folder / "cam_params.json").write_text(json.dumps({"camera": camera}))


def test_parameters_for_another_size_of_the_same_view_are_rescaled(tmp_path: Path) -> None:
    write_replica(tmp_path, 1)
    write_parameters(tmp_path, w=64, h=48, fx=64.0, fy=64.0, cx=31.5, cy=23.5)
    assert Reader(tmp_path, Options())[0].intrinsics == Intrinsics(32, 24, 32.0, 32.0, 15.5, 11.5)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"fx": 0.0}, "unusable intrinsics"),
        ({"cy": float("nan")}, "it holds NaN instead of a number"),
        ({"fx": "wide"}, r"'camera.fx' has text instead of a number"),
        ({"w": 32, "h": 32}, "for images of 32 x 32 pixels, but the images have 32 x 24"),
        ({"w": 10**400}, r"'camera.w' has a number that is too large"),
        ({"scale": 0}, r"'camera.scale' has a number that is not >= 0.001"),
    ],
)
def test_unusable_parameters_name_their_file(tmp_path: Path, changes: dict[str, object], message: str) -> None:
    write_replica(tmp_path, 1)
    write_parameters(tmp_path, **changes)
    with pytest.raises(CaptureError, match=message) as caught:
        Reader(tmp_path, Options())
    assert "cam_params.json" in str(caught.value)


@pytest.mark.parametrize("content", ["{", "[]", "{}", '{"camera": []}'])
def test_a_parameter_file_of_another_kind_is_named(tmp_path: Path, content: str) -> None:
    write_replica(tmp_path, 1)
    (tmp_path / "cam_params.json").write_text(content)
    with pytest.raises(CaptureError, match=r"cam_params\.json"):
        Reader(tmp_path, Options())


def test_without_parameters_the_options_can_state_them(tmp_path: Path) -> None:
    write_replica(tmp_path / "office0", 1)
    (tmp_path / "office0" / "cam_params.json").unlink()
    with pytest.raises(CaptureError, match=r"no cam_params\.json in .* or its parent folder"):
        Reader(tmp_path / "office0", Options())
    frame = Reader(tmp_path / "office0", Options(intrinsics=(32.0, 32.0, 15.5, 11.5)))[0]
    assert frame.depth_m.max() == pytest.approx(2.0, abs=1e-4)


def test_class_names_of_another_kind_are_refused(tmp_path: Path) -> None:
    write_replica(tmp_path, 1)
    (tmp_path / "classes.json").write_text('{"classes": [{"id": 1, "name": "sofa"}]}')
    with pytest.raises(CaptureError, match=r"classes\.json must hold a list of names"):
        Reader(tmp_path, Options())


@pytest.mark.parametrize("room", ["living", "bedroom"])
def test_the_house_has_color_depth_poses_and_classes(room: str) -> None:
    capture = Reader(data_folder() / "house" / room, Options())
    frame, labels = capture[100], capture.labels(100)
    assert frame.color.shape == (480, 640, 3)
    assert 0.5 < np.median(frame.depth_m[frame.depth_m > 0]) < 5.0
    assert capture.pose(100) is not None
    assert labels is not None
    assert labels.shape == (480, 640)
    assert 0 < labels.max() < len(capture.classes)
