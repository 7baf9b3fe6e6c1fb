"""A lens: undistorted pixels match OpenCV's own point formula, and a lens without distortion changes nothing."""

import cv2
import numpy as np

from freeocc3d.capture.cameras.lenses import Lens
from freeocc3d.capture.cameras.undistortion import Rectified
from freeocc3d.core.types import Intrinsics

CAMERA = Intrinsics(160, 120, 130.0, 131.0, 80.5, 58.0)


def test_undistorted_images_are_those_of_the_pinhole_camera() -> None:
    lens = Lens(CAMERA, (-0.2, 0.05, 0.003, -0.002))
    rectified = Rectified(lens, None)
    pinhole = rectified.intrinsics
    assert (pinhole.width, pinhole.height) == (160, 120)
    taken = np.zeros((120, 160, 3), np.uint8)
    dots = np.array([(30, 25), (80, 60), (130, 95), (25, 100)], np.float32)
    for u, v in dots.astype(int):
        cv2.circle(taken, (u, v), 3, (255, 255, 255), -1, cv2.LINE_AA)
    expected = cv2.undistortPoints(
        dots[:, None], CAMERA.matrix, np.array(lens.distortion), None, None, pinhole.matrix
    ).reshape(-1, 2)
    seen = rectified.color(taken)[:, :, 0].astype(float)
    for u, v in expected:
        window = np.s_[int(v) - 6 : int(v) + 8, int(u) - 6 : int(u) + 8]
        rows, columns = np.mgrid[window]
        weight = seen[window].sum()
        assert abs((seen[window] * columns).sum() / weight - u) < 0.2
        assert abs((seen[window] * rows).sum() / weight - v) < 0.2


def test_no_pixel_of_an_undistorted_image_lies_outside() -> None:
    inside = np.ones((120, 160), np.float32)  # of depth, which has a hole where nothing was seen
    for k1 in (-0.25, 0.15):
        assert Rectified(Lens(CAMERA, (k1, 0.0, 0.0, 0.0)), None).depth(inside)[1:-1, 1:-1].all()


def test_without_distortion_images_are_the_same_arrays() -> None:
    color = np.zeros((120, 160, 3), np.uint8)
    rectified = Rectified(Lens(CAMERA, (0.0, 0.0, 0.0, 0.0)), None)
    assert rectified.color(color) is color
    assert rectified.intrinsics == CAMERA
    distorted = Rectified(Lens(CAMERA, (-0.2, 0.0, 0.0, 0.0)), None)
    depth_m = np.where(np.arange(120)[:, None] < 60, np.float32(1), np.float32(2)) * np.ones((1, 160), np.float32)
    assert set(np.unique(distorted.depth(depth_m))) == {1.0, 2.0}, "depth is never interpolated"
