"""Frames of a long scan: sharp ones, spaced by image motion."""

import cv2
import numpy as np
import pytest
from photographs import Photographs

from freeocc3d.core.errors import FrameError
from freeocc3d.core.progress import Progress
from freeocc3d.core.types import Frame, Intrinsics
from freeocc3d.tracking.sfm import frame_selection

CAMERA = Intrinsics(160, 120, 130.0, 130.0, 79.5, 59.5)


def panorama(offsets: list[int], blurred: set[int] = frozenset()) -> list[np.ndarray]:  # type: ignore[assignment]
    """Windows of a random picture at horizontal offsets."""
    picture = cv2.GaussianBlur(np.random.default_rng(0).integers(0, 256, (120, 1200, 3), np.uint8), (0, 0), 2)
    images = [np.ascontiguousarray(picture[:, x : x + 160]) for x in offsets]
    return [cv2.GaussianBlur(i, (0, 0), 3) if n in blurred else i for n, i in enumerate(images)]


def test_the_way_is_cut_evenly_and_the_sharpest_taken() -> None:
    moved, sharp = np.ones(12), np.tile([1.0, 3.0, 2.0], 4)
    rows = frame_selection.spread_frames(sharp, moved, 4)
    assert len(rows) == 4
    assert set(sharp[rows]) == {3.0}
    resting = np.r_[np.ones(5), np.zeros(40), np.ones(5)]
    rows = frame_selection.spread_frames(np.ones(50), resting, 10)
    assert sum(5 <= row < 45 for row in rows) <= 2
    assert len(frame_selection.spread_frames(np.ones(50), np.zeros(50), 10)) == 10


def test_motion_is_that_of_the_image() -> None:
    gray = [cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in panorama([0, 8, 500])]
    assert abs(frame_selection.measure_motion(gray[0], gray[1]) - 8 / 160) < 0.005
    assert frame_selection.measure_motion(gray[0], gray[2]) > 0.1
    assert frame_selection.measure_motion(np.zeros_like(gray[0]), gray[0]) > 0.1


def test_blurred_and_broken_frames_and_those_of_a_camera_at_rest_are_left_out() -> None:
    offsets = [*range(0, 120, 6), *[120] * 30, *range(120, 240, 6)]
    blurred = set(range(1, 70, 2))

    class Broken(Photographs):
        def __getitem__(self, index: int) -> Frame:
            if index == 4:
                raise FrameError("broken")
            return super().__getitem__(index)

    capture = Broken(panorama(offsets, blurred), CAMERA)
    chosen = frame_selection.choose_frames(capture, range(len(offsets)), 10, Progress())
    assert len(chosen) <= 10
    assert chosen == sorted(set(chosen))
    assert not set(chosen) & (blurred | {4})
    assert sum(20 <= index < 50 for index in chosen) <= 2
    assert frame_selection.choose_frames(capture, range(0, 20, 2), 10, Progress()) == list(range(0, 20, 2))


def test_parts_are_as_long_as_each_other_and_the_first_and_last_frame_belong_to_the_first_and_last() -> None:
    rng = np.random.default_rng(0)
    moved = rng.uniform(0.01, 0.1, 60)
    sharp = rng.uniform(1, 2, 60)
    way = np.cumsum(moved) - moved[0]
    bounds = np.linspace(0, way[-1], 8)
    chosen = frame_selection.spread_frames(sharp, moved, 7)
    assert len(chosen) == 7
    for row, low, high in zip(chosen, bounds, bounds[1:], strict=False):
        inside = np.flatnonzero((way >= low - 1e-9) & (way < high - 1e-9) | ((high == bounds[-1]) & (way >= low)))
        assert row == inside[np.argmax(sharp[inside])]


def test_motion_is_the_median_of_the_corners_and_at_most_a_quarter_of_the_width() -> None:
    picture = cv2.GaussianBlur(np.random.default_rng(0).integers(0, 256, (200, 400), np.uint8), (0, 0), 2)
    before = np.ascontiguousarray(picture[40:160, 40:200])
    for x, y in ((6, 0), (0, 6), (3, -4)):
        after = np.ascontiguousarray(picture[40 + y : 160 + y, 40 + x : 200 + x])
        assert frame_selection.measure_motion(before, after) == pytest.approx(np.hypot(x, y) / 160, abs=0.003)
    half = before.copy()
    half[:, :40] = picture[40:160, 48:88]  # a quarter of the image moves: most corners stay
    assert frame_selection.measure_motion(before, half) < 0.003
    few = np.zeros_like(before)
    few[40:60, 40:60] = 200
    assert frame_selection.measure_motion(few, few) == 0.25  # four corners tell nothing


def test_crisp_edges_are_sharp_and_small_images_keep_their_size() -> None:
    sharp, soft = panorama([0, 0], {1})
    assert frame_selection.measure_sharpness(sharp[..., 0]) > 3 * frame_selection.measure_sharpness(soft[..., 0])
    assert frame_selection._small(np.zeros((30, 320, 3), np.uint8)).shape == (30, 320)
    assert frame_selection._small(np.zeros((300, 640, 3), np.uint8)).shape == (150, 320)
    assert frame_selection._small(np.zeros((1, 2000, 3), np.uint8)).shape == (1, 320)
