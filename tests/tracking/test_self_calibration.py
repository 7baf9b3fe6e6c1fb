"""The focal length of a scan whose camera nobody knows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from small_captures import data_folder

from freeocc3d.capture import open_capture
from freeocc3d.capture.base import Capture
from freeocc3d.core.types import Frame
from freeocc3d.tracking.rgbd.self_calibration import _error, _fit, _Matches, estimate_focal


class Unknown(Capture):
    """A capture whose frames state a camera with 1.3 times the focal length."""

    def __init__(self, capture: Capture):
        super().__init__(capture.path, capture.options)
        self.timestamps, self._capture = capture.timestamps, capture

    @classmethod
    def recognizes(cls, path: object) -> bool:
        return False

    def __getitem__(self, index: int) -> Frame:
        frame = self._capture[index]
        K = frame.intrinsics
        return replace(frame, intrinsics=replace(K, fx=1.3 * K.fx, fy=1.3 * K.fy))


def test_the_room_shows_its_focal_length_whatever_is_stated() -> None:
    room = open_capture("builtin:room", None, {"synthetic": {"frames": 60, "width": 320, "height": 240}})
    found = estimate_focal(Unknown(room), range(60))
    assert found is not None
    assert found.sure
    assert found.focal_px == pytest.approx(room[0].intrinsics.fx, rel=0.02)


@pytest.mark.parametrize(("name", "frames"), [("house/bedroom", range(50, 80)), ("house/living", range(100, 160, 2))])
def test_a_short_piece_shows_it(name: str, frames: range) -> None:
    capture = open_capture(data_folder() / name)
    found = estimate_focal(capture, frames)
    assert found is not None
    assert found.sure
    assert found.focal_px == pytest.approx(525.0, rel=0.02)


def test_a_camera_that_does_not_move_shows_nothing() -> None:
    room = open_capture("builtin:room", None, {"synthetic": {"frames": 4, "width": 160, "height": 120}})
    assert estimate_focal(room, range(1)) is None


def test_the_error_is_least_at_the_true_focal_length() -> None:
    """Exact points, turned by 20 degrees and moved."""
    rng = np.random.default_rng(0)
    p = rng.uniform((-1, -1, 1.5), (1, 1, 3), (200, 3))
    angle = np.radians(20)
    R = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    q = p @ R.T + (0.1, 0.0, 0.2)
    pair = _Matches(500 * p[:, :2] / p[:, 2:], 500 * q[:, :2] / q[:, 2:], p[:, 2], q[:, 2])
    assert _error(pair, 500.0) < 1e-6
    assert min(_error(pair, 450.0), _error(pair, 550.0)) > 0.05
    found_R, found_t = _fit(p, q, np.ones(200))
    np.testing.assert_allclose(found_R, R, atol=1e-9)
    np.testing.assert_allclose(found_t, (0.1, 0.0, 0.2), atol=1e-9)
