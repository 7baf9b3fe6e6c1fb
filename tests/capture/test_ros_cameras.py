"""CameraInfo becomes lenses, and tf the place of the depth camera."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ros_bags import COLOR, DEPTH, Messages, Sent, write_bag
from small_captures import SIZE, color_image, depth_image, pose_matrix

from freeocc3d.capture.base import Options
from freeocc3d.capture.cameras.lenses import Lens
from freeocc3d.capture.readers.ros_bag import Reader
from freeocc3d.capture.ros.camera_messages import FrameTree, lens_of_info
from freeocc3d.core.errors import CaptureError
from freeocc3d.core.transforms import invert

K = 40.0, 41.0, 15.5, 11.5


def lens(size: tuple[int, int] = SIZE, rectified: bool = False, **stated: Any) -> Lens | None:
    values = {"K": K, **stated}
    return lens_of_info(Messages("db3").info(SIZE, **values), size, rectified, "camera_info")


@pytest.mark.parametrize("model", ["plumb_bob", "rational_polynomial", "Brown Conrady"])
def test_coefficients_keep_opencvs_order(model: str) -> None:
    found = lens(D=(0.1, -0.2, 0.01, 0.02, 0.3), model=model)
    assert found == Lens(found.camera, (0.1, -0.2, 0.01, 0.02, 0.3))  # type: ignore[union-attr]
    assert (found.camera.fx, found.camera.fy, found.camera.cx, found.camera.cy) == K  # type: ignore[union-attr]


def test_eight_coefficients_and_zeros_behind_them() -> None:
    D = tuple(0.01 * n for n in range(1, 9))
    assert lens(D=(*D, 0, 0, 0, 0, 0, 0), model="rational_polynomial").distortion == D  # type: ignore[union-attr]


def test_a_fisheye() -> None:
    found = lens(D=(0.1, 0.2, 0.3, 0.4), model="equidistant")
    assert found is not None
    assert (found.fisheye, found.distortion) == (True, (0.1, 0.2, 0.3, 0.4))


def test_rectified_images_have_the_camera_p_and_no_distortion() -> None:
    found = lens(rectified=True, D=(0.1, 0, 0, 0, 0), P=(30, 31, 14, 10))
    assert found is not None
    assert (found.camera.fx, found.camera.cy, found.distortion) == (30, 10, ())


def test_no_camera_is_stated() -> None:
    assert lens(K=(0, 0, 0, 0)) is None


def test_larger_images_rescale_the_camera_and_binning_reduces_it() -> None:
    twice = lens(size=(64, 48))
    assert twice is not None
    assert (twice.camera.fx, twice.camera.cx) == (80, 31.5)
    half = lens(size=(16, 12), binning_x=2, binning_y=2)
    assert half is not None
    assert (half.camera.fx, half.camera.cx) == (20, 7.5)


@pytest.mark.parametrize(
    ("stated", "said"),
    [
        ({"D": (0.1, 0, 0, 0), "model": "ftheta"}, "'ftheta', which is not supported"),
        ({"D": tuple(range(20))}, "20 coefficients"),
        ({"D": (np.nan, 0, 0, 0)}, "not those of a lens"),
        ({"K": (np.nan, 40, 15, 11)}, "unusable intrinsics"),
    ],
)
def test_impossible_cameras_are_refused(stated: dict[str, Any], said: str) -> None:
    with pytest.raises(CaptureError, match=said):
        lens(**stated)


def test_frames_are_found_along_the_tree() -> None:
    A, B, C = (pose_matrix(n) for n in (3, 7, 11))
    tree = FrameTree()
    tree.add([Messages("bag").transforms(("base", "/color", A), ("base", "left", B)), *others(C)])
    np.testing.assert_allclose(tree.find("color", "depth"), invert(A) @ B @ C, atol=1e-9)
    assert tree.find("color", "arm") is None
    assert tree.find("color", "nowhere") is None


def others(C: Any) -> list[Any]:
    messages = Messages("bag")
    moving = [messages.transforms(("base", "arm", pose_matrix(n))) for n in (1, 2)]
    return [messages.transforms(("left", "depth", C)), *moving]


@pytest.mark.parametrize("kind", ["bag", "mcap"])
def test_depth_moves_to_the_color_camera(kind: Any, tmp_path: Path) -> None:
    """A depth camera 20 cm to the left: at 2 m, depth appears 0.2 * 40 / 2 = 4 pixels to the left."""
    messages = Messages(kind)
    T_base_depth, T_base_color = np.eye(4), np.eye(4)
    T_base_color[0, 3] = 0.2
    edges = messages.transforms(("base", "depth", T_base_depth), ("base", "color", T_base_color))
    sent: list[Sent] = [
        ("/tf_static", 0, edges),
        ("/camera/color/camera_info", 0, messages.info(SIZE, K, frame="color")),
        ("/camera/depth/camera_info", 0, messages.info(SIZE, K, frame="depth")),
    ]
    for index in range(3):
        sent.append((COLOR, index, messages.image(color_image(index), "rgb8", index + 1, frame="color")))
        depth = depth_image(0)
        depth[:, 16:] = 3000
        sent.append((DEPTH, index, messages.image(depth, "16UC1", index + 1, frame="depth")))
    capture = Reader(write_bag(tmp_path / "scan", messages, sent), Options())
    row = capture[1].depth_m[12]
    assert row[10] == pytest.approx(2)
    assert row[13] == pytest.approx(3)
    np.testing.assert_array_equal(capture[1].color, color_image(1))


def test_a_camera_is_found_by_its_frame(tmp_path: Path) -> None:
    messages = Messages("db3")
    sent: list[Sent] = [
        ("/somewhere/camera_info", 0, messages.info(SIZE, K, frame="eye")),
        ("/other/camera_info", 0, messages.info(SIZE, (20, 20, 15, 11), frame="other")),
        *[("/images", n, messages.image(color_image(n), "rgb8", n + 1, frame="eye")) for n in range(2)],
    ]
    capture = Reader(write_bag(tmp_path / "scan", messages, sent), Options())
    assert capture.intrinsics_known
    assert capture[0].intrinsics.fx == 40


def two_frames(messages: Messages) -> list[Sent]:
    sent: list[Sent] = []
    for index in range(3):
        at = index * 10**8
        sent.append((COLOR, at, messages.image(color_image(index), "rgb8", 1 + index / 10, frame="color")))
        sent.append((DEPTH, at, messages.image(depth_image(0), "16UC1", 1 + index / 10, frame="depth")))
    return sent


def test_cameras_apart_without_a_transform_are_told(tmp_path: Path) -> None:
    messages = Messages("db3")
    capture = Reader(write_bag(tmp_path / "scan", messages, two_frames(messages)), Options())
    assert [notice.code for notice in capture.warnings] == ["extrinsics-unknown"]
    assert "Record /tf_static" in capture.warnings[0].text
    assert capture.pose(0) is None


def test_extrinsics_of_realsense_ros_are_read(tmp_path: Path) -> None:
    """A message that rosbags does not know: rotation by columns, then the translation."""
    from rosbags.typesys import get_types_from_msg

    messages = Messages("mcap")
    kind = "realsense2_camera_msgs/msg/Extrinsics"
    if kind not in messages.store.fielddefs:
        messages.store.register(get_types_from_msg("float64[9] rotation\nfloat64[3] translation\n", kind))
    T = pose_matrix(5)
    stated = messages.store.types[kind](rotation=T[:3, :3].T.reshape(-1).copy(), translation=T[:3, 3].copy())
    sent: list[Sent] = [("/camera/extrinsics/depth_to_color", 0, stated), *two_frames(messages)]
    capture = Reader(write_bag(tmp_path / "scan", messages, sent), Options())
    assert capture.warnings == ()
    np.testing.assert_allclose(capture.rig(0).T_color_depth, T, atol=1e-12)


def moving(messages: Messages, parent: str, child: str, seconds: float, T: Any) -> Any:
    message = messages.transforms((parent, child, T))
    message.transforms[0].header = messages.header(seconds, parent)
    return message


@pytest.mark.parametrize("kind", ["bag", "db3"])
def test_poses_follow_the_frames_up_to_the_one_that_stands_still(kind: Any, tmp_path: Path) -> None:
    messages = Messages(kind)
    T_base_color = pose_matrix(4)
    sent: list[Sent] = [("/tf_static", 0, messages.transforms(("base", "color", T_base_color)))]
    for row in range(3):  # half a step before, and half a step after the first two images
        at = 0.95 + row / 10
        sent.append(("/tf", round(at * 1e9), moving(messages, "map", "base", at, pose_matrix(2 * row))))
    capture = Reader(write_bag(tmp_path / "scan", messages, [*sent, *two_frames(messages)]), Options())
    for index in range(2):
        pose = capture.pose(index)
        assert pose is not None
        np.testing.assert_allclose(pose, pose_matrix(2 * index + 1) @ T_base_color, atol=1e-3)
    assert capture.pose(2) is None  # after the last transform


def test_frames_in_a_circle_have_no_pose(tmp_path: Path) -> None:
    messages = Messages("bag")
    sent: list[Sent] = []
    for row in range(4):
        sent.append(("/tf", row, moving(messages, "a", "color", 0.9 + row / 10, pose_matrix(row))))
        sent.append(("/tf", row, moving(messages, "color", "a", 0.9 + row / 10, pose_matrix(row))))
    capture = Reader(write_bag(tmp_path / "scan.bag", messages, [*sent, *two_frames(messages)]), Options())
    assert capture.pose(0) is None
