"""Frames of a long scan: sharp ones, spaced by image motion."""

import cv2
import numpy as np
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
