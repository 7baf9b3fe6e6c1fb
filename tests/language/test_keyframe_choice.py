"""The choice of keyframes to encode when not all are encoded: sharp ones that show the most."""

from __future__ import annotations

import itertools

import cv2
import numpy as np
import pytest

from freeocc3d.language.keyframe_choice import choose_keyframes, measure_detail
from freeocc3d.language.visibility import VisibleGaussians


def view(rows: object, weight: float = 1.0) -> VisibleGaussians:
    rows = np.asarray(rows, np.int32)
    return VisibleGaussians(rows, np.zeros(len(rows), np.int32), np.full(len(rows), weight, np.float32), (4, 4))


def test_new_surface_comes_first() -> None:
    views = [view(range(60)), view(range(58)), view(range(60, 80))]
    assert choose_keyframes(views, [1, 1, 1], 80, 1) == [0]
    assert choose_keyframes(views, [1, 1, 1], 80, 2) == [0, 2]


def test_of_two_views_of_the_same_the_near_one_is_taken() -> None:
    assert choose_keyframes([view(range(60), 1.0), view(range(60), 4.0)], [1, 1], 60, 1) == [1]


def test_of_two_views_of_the_same_the_sharp_one_is_taken() -> None:
    views = [view(range(50)), view(range(50)), view(range(50, 60))]
    assert choose_keyframes(views, [0.2, 1.0, 1.0], 60, 1) == [1]


def test_what_only_a_blurred_view_shows_is_taken_all_the_same() -> None:
    assert choose_keyframes([view(range(50)), view(range(50, 60))], [1.0, 0.0], 60, 2) == [0, 1]
    assert choose_keyframes([view(range(50)), view(range(40))], [0.0, 0.0], 60, 1) == [0]


def test_what_adds_nothing_is_left_out() -> None:
    assert choose_keyframes([view([]), view(range(9)), view(range(5))], [1] * 3, 9, 3) == [1, 2]
    assert choose_keyframes([], [], 9, 3) == []


def test_no_more_are_chosen_than_show_the_share_that_is_asked() -> None:
    views = [view(range(60)), view(range(50, 95)), view(range(95, 100)), view(range(20))]
    assert choose_keyframes(views, [1] * 4, 120, 4, 0.95) == [0, 1]
    assert choose_keyframes(views, [1] * 4, 120, 4, 0.96) == [0, 1, 2]
    assert choose_keyframes(views, [1] * 4, 120, 1, 0.96) == [0]


@pytest.mark.parametrize("seed", range(5))
def test_greedy_choice_is_near_the_best(seed: int) -> None:
    rng = np.random.default_rng(seed)
    views = [view(np.flatnonzero(rng.random(40) < 0.3)) for _ in range(8)]

    def shown(rows: object) -> float:
        return float(np.log1p(100 * sum(np.bincount(views[row].rows, minlength=40) for row in rows)).sum())

    best = max(shown(rows) for rows in itertools.combinations(range(8), 3))
    assert shown(choose_keyframes(views, [1] * 8, 40, 3)) >= (1 - 1 / np.e) * best


def test_sharpness_falls_with_blur_and_not_with_brightness() -> None:
    image = cv2.GaussianBlur(np.random.default_rng(0).integers(0, 255, (240, 320, 3)).astype(np.uint8), (0, 0), 1)
    sharp = measure_detail(image)
    assert measure_detail(cv2.GaussianBlur(image, (0, 0), 2)) < 0.3 * sharp
    assert measure_detail(cv2.blur(image, (9, 1))) < 0.7 * sharp
    assert measure_detail(image // 2) == pytest.approx(sharp, rel=0.1)
    assert measure_detail(np.zeros((240, 320, 3), np.uint8)) == 0


def test_detail_of_a_large_image_is_that_of_the_image_at_320_columns() -> None:
    rng = np.random.default_rng(0)
    small = cv2.GaussianBlur(rng.integers(0, 256, (60, 320, 3), np.uint8), (0, 0), 1.5)
    large = np.repeat(np.repeat(small, 3, axis=0), 3, axis=1)
    assert measure_detail(large) == pytest.approx(measure_detail(small), rel=1e-6)
    assert measure_detail(np.repeat(large[:1], 2, axis=0)) >= 0  # no thinner than a row
