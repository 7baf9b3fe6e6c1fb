"""A lens: undistorted pixels where OpenCV's own point formula puts them, and nothing done where nothing distorts."""

import cv2
import numpy as np

from freeocc3d.tracking.lens import LensCamera
from freeocc3d.types import Intrinsics

CAMERA = Intrinsics(160, 120, 130.0, 131.0, 80.5, 58.0)


def test_undistorted_images_are_those_of_the_pinhole_camera() -> None:
    lens = LensCamera(CAMERA, (-0.2, 0.05, 0.003, -0.002))
    pinhole = lens.pinhole()
    assert (pinhole.width, pinhole.height) == (160, 120)
    taken = np.zeros((120, 160, 3), np.uint8)
    dots = np.array([(30, 25), (80, 60), (130, 95), (25, 100)], np.float32)
    for u, v in dots.astype(int):
        cv2.circle(taken, (u, v), 3, (255, 255, 255), -1, cv2.LINE_AA)
    expected = cv2.undistortPoints(
        dots[:, None], CAMERA.matrix, np.array(lens.distortion), None, None, pinhole.matrix
    ).reshape(-1, 2)
    seen = lens.undistorted(taken)[:, :, 0].astype(float)
    for u, v in expected:
        window = np.s_[int(v) - 6 : int(v) + 8, int(u) - 6 : int(u) + 8]
        rows, columns = np.mgrid[window]
        weight = seen[window].sum()
        assert abs((seen[window] * columns).sum() / weight - u) < 0.2
        assert abs((seen[window] * rows).sum() / weight - v) < 0.2


def test_no_pixel_of_an_undistorted_image_lies_outside() -> None:
    white = np.full((120, 160, 3), 255, np.uint8)
    for k1 in (-0.25, 0.15):
        assert LensCamera(CAMERA, (k1, 0.0, 0.0, 0.0)).undistorted(white).min() > 200


def test_without_distortion_images_stay_what_they_are() -> None:
    color = np.zeros((120, 160, 3), np.uint8)
    lens = LensCamera(CAMERA)
    assert lens.undistorted(color) is color
    assert lens.pinhole() == CAMERA
