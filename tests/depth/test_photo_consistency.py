"""Matching scores against a plain per-pixel reference."""

import numpy as np
import pytest
import torch
from textured import CAMERA, Rectangle, looking, render

from freeocc3d.core.transforms import back_project, invert, project, transform
from freeocc3d.core.types import Intrinsics
from freeocc3d.depth.photo_consistency import (
    NOISE,
    Matcher,
    StereoView,
    average_best_half,
    average_box,
    average_box_reference,
)

WALL = [Rectangle((-3, -3, 2.0), (6, 0, 0.5), (0, 6, 0))]
RADIUS = 2


def _views():
    made = [render(WALL, looking(x, 0.02 * x), noise=0.0)[0] for x in (0.0, 0.2, -0.15)]
    return [view.shrunk(CAMERA.width, CAMERA.height) for view in made]


def _plain_score(view, other, inverse, row, column):
    """Of one pixel: None where a part of the patch is outside the other image."""
    ours, theirs = [], []
    for v in range(row - RADIUS, row + RADIUS + 1):
        for u in range(column - RADIUS, column + RADIUS + 1):
            point = back_project(np.array((u, v), float), np.array(1.0 / inverse[v, u]), view.intrinsics)
            T = invert(other.T_world_cam) @ view.T_world_cam
            (x, y), _ = project(transform(T, point), other.intrinsics)
            i, j = int(np.floor(y)), int(np.floor(x))
            if not (0 <= i < CAMERA.height - 1 and 0 <= j < CAMERA.width - 1):
                return None
            f, g = y - i, x - j
            image = other.color
            theirs.append(
                (image[i, j] * (1 - g) + image[i, j + 1] * g) * (1 - f)
                + (image[i + 1, j] * (1 - g) + image[i + 1, j + 1] * g) * f
            )
            ours.append(view.color[v, u])
    a, b = np.array(ours, float), np.array(theirs, float)
    covariance = (a * b).mean() - a.mean() * b.mean()
    return covariance / np.sqrt((a.var() + NOISE**2) * (b.var() + NOISE**2))


def test_scores_are_those_of_a_plain_implementation() -> None:
    view, *others = _views()
    rng = np.random.default_rng(0)
    inverse = np.asarray(0.5 + 0.05 * rng.random((CAMERA.height, CAMERA.width)), np.float32)
    scores = Matcher(view, others, RADIUS).scores(torch.from_numpy(inverse)[None])[:, 0].numpy()
    compared = 0
    for row, column in rng.integers((5, 5), (CAMERA.height - 5, CAMERA.width - 5), (60, 2)):
        for n, other in enumerate(others):
            plain = _plain_score(view, other, inverse, row, column)
            if plain is not None:
                compared += 1
                assert abs(scores[n, row, column] - plain) < 2e-3
    assert compared > 60


def test_one_depth_for_all_pixels_and_one_for_each_score_alike() -> None:
    view, *others = _views()
    matcher = Matcher(view, others, RADIUS)
    planes = torch.linspace(0.3, 0.7, 9)[:, None, None]
    each = planes.expand(-1, CAMERA.height, CAMERA.width)
    torch.testing.assert_close(matcher.scores(planes), matcher.scores(each))
    torch.testing.assert_close(matcher.agreement(planes), average_best_half(matcher.scores(each)))


def test_what_no_view_sees_scores_nothing() -> None:
    view, *others = _views()
    assert (Matcher(view, others, RADIUS).scores(torch.full((1, 1, 1), 50.0)).abs() < 1e-6).float().mean() > 0.9


def test_better_half_of_the_views() -> None:
    scores = torch.tensor([[0.9, -1.0], [0.1, 0.5], [0.7, 0.3], [-0.5, 0.1]])
    torch.testing.assert_close(average_best_half(scores), torch.tensor([0.8, 0.4]))
    torch.testing.assert_close(average_best_half(scores[:1]), scores[0])


def test_means_at_the_border_are_of_what_is_inside() -> None:
    image = torch.arange(20.0).reshape(1, 4, 5)
    means = average_box(image, 1)[0]
    assert means[0, 0] == image[0, :2, :2].mean()
    assert means[2, 3] == image[0, 1:4, 2:5].mean()


def test_means_are_those_that_pooling_gives() -> None:
    images = torch.from_numpy(np.random.default_rng(0).random((3, 17, 23), np.float32)) - 0.5
    for radius in (1, 2, 3):
        torch.testing.assert_close(average_box(images, radius), average_box_reference(images, radius))


def test_a_steps_pixel_is_that_of_the_middle_baseline() -> None:
    camera, image = Intrinsics(8, 6, 5.0, 5.0, 3.5, 2.5), np.zeros((6, 8), np.float32)
    others = []
    for x in (0.1, 0.5, 2.0):
        T = np.eye(4)
        T[1, 3] = x
        others.append(StereoView(image, camera, T))
    assert Matcher(StereoView(image, camera, np.eye(4)), others, 1).pixel == pytest.approx(1 / (5.0 * 0.5))
