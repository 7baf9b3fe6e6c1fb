"""Whether depth lies on color: rendered and real scans, and the same with depth moved."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import cv2
import numpy as np
import pytest
from small_captures import data_folder

from freeocc3d.capture import open_capture
from freeocc3d.capture.base import Capture
from freeocc3d.capture.checks.registration_check import check_registration, fit_edges
from freeocc3d.capture.focal_correction import Reregistered
from freeocc3d.core.types import Frame


@pytest.fixture(scope="module")
def room() -> list[Frame]:
    capture = open_capture("builtin:room", None, {"synthetic": {"frames": 8, "width": 320, "height": 240}})
    return [capture[index] for index in range(8)]


def moved(frames: list[Frame], right: float = 0, down: float = 0, scale: float = 1) -> Iterator[Frame]:
    """The frames with depth that is magnified about the center and shifted."""
    height, width = frames[0].depth_m.shape
    cx, cy = (width - 1) / 2, (height - 1) / 2
    M = np.array([[scale, 0, cx - scale * cx + right], [0, scale, cy - scale * cy + down]])
    for frame in frames:
        yield replace(frame, depth_m=cv2.warpAffine(frame.depth_m, M, (width, height), flags=cv2.INTER_NEAREST))


def test_depth_that_lies_on_color_raises_no_doubt(room) -> None:
    fit = fit_edges(room)
    assert fit is not None
    assert not fit.doubtful
    assert np.hypot(*fit.shift) <= 2


@pytest.mark.parametrize(("right", "down", "scale"), [(10, 0, 1), (-14, 6, 1), (0, -8, 1), (0, 0, 1.2), (6, 0, 0.85)])
def test_depth_that_is_moved_is_noticed_with_the_move_that_helps(room, right: int, down: int, scale: float) -> None:
    fit = fit_edges(moved(room, right, down, scale))
    assert fit is not None
    assert fit.doubtful
    assert fit.scale == pytest.approx(1 / scale, abs=0.06)
    if scale == 1:
        assert fit.shift == pytest.approx((-right, -down), abs=3)


@pytest.mark.parametrize("name", ["7scenes-kitchen", "house/bedroom", "house/living"])
def test_real_captures_raise_no_doubt(name: str) -> None:
    capture: Capture = open_capture(data_folder() / name)
    if name == "7scenes-kitchen":  # its color camera has another focal length, which a run finds first
        notice = check_registration(capture, range(len(capture)))
        assert notice is not None
        assert "grows by 0.9" in notice.text
        capture = Reregistered(capture, 0.903)
    assert check_registration(capture, range(len(capture))) is None


@pytest.mark.parametrize(("baseline_m", "told"), [(0.025, False), (0.075, True)])
@pytest.mark.parametrize("first", [0, 120])
def test_cameras_that_lie_near_each_other_do_no_harm(baseline_m: float, told: bool, first: int) -> None:
    """Wherever the scan is: near surfaces move by more pixels than far ones."""
    capture = open_capture("builtin:room", None, {"synthetic": {"frames": 240, "width": 320, "height": 240}})
    found = []
    for index in range(first, first + 60, 6):
        frame = capture[index]
        apart = round(frame.intrinsics.fx * baseline_m / float(np.median(frame.depth_m[frame.depth_m > 0])))
        found += moved([frame], apart)
    fit = fit_edges(found)
    assert fit is not None
    assert fit.doubtful == told


def test_images_without_edges_say_nothing(room) -> None:
    flat = [replace(frame, depth_m=np.full_like(frame.depth_m, 2.0)) for frame in room]
    assert fit_edges(flat) is None
    assert fit_edges([replace(frame, color=np.zeros_like(frame.color)) for frame in room]) is None
