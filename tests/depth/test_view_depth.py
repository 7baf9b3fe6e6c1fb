"""Depth of one view from its neighbors, against analytic depth."""

import numpy as np
import pytest
import torch
from textured import CAMERA, Rectangle, looking, render

from freeocc3d.depth import multi_view_stereo
from freeocc3d.depth.view_depth import filter_median, filter_median_reference, measure_depth

SLANTED = Rectangle((-3, -3, 1.5), (6, 0, 1.0), (0, 6, 0.6))
PLACES = (0.0, -0.3, -0.15, 0.15, 0.3)


def _views(rectangles, noise=1.0):
    made = [render(rectangles, looking(x, 0.1 * x), noise=noise) for x in PLACES]
    views = [view.shrunk(CAMERA.width, CAMERA.height) for view, _ in made]
    return views[0], views[1:], made[0][1]


def test_a_slanted_wall_is_measured_to_a_fraction_of_a_pixel() -> None:
    view, others, depth = _views([SLANTED])
    found = measure_depth(view, others, others, 1.0, 6.0)
    known = found.inverse > 0
    assert known.mean() > 0.75
    pixels = np.abs(found.inverse - 1.0 / depth)[known] * CAMERA.fx * 0.225  # in the views' median baseline
    assert np.median(pixels) < 0.1
    assert np.percentile(pixels, 95) < 0.5


def test_sigma_is_what_errors_are() -> None:
    view, others, depth = _views([SLANTED], noise=4.0)
    found = measure_depth(view, others, others, 1.0, 6.0)
    known = found.inverse > 0
    off = np.abs(found.inverse - 1.0 / depth)[known] / found.sigma[known]
    assert 0.1 < np.median(off) < 1.0
    assert np.percentile(off, 95) < 3.0


def test_what_has_no_texture_is_not_measured() -> None:
    view, others, _ = _views([Rectangle((-3, -3, 2.0), (6, 0, 0), (0, 6, 0), blank=(0.0, 1.0))])
    assert (measure_depth(view, others, others, 1.0, 6.0).inverse > 0).mean() < 0.02


def test_edges_of_what_stands_in_front_stay_where_they_are() -> None:
    box = Rectangle((-0.25, -0.4, 1.4), (0.5, 0, 0), (0, 0.8, 0), seed=1)
    view, others, depth = _views([Rectangle((-4, -4, 3.0), (8, 0, 0), (0, 8, 0)), box])
    found = measure_depth(view, others, others, 1.0, 6.0)
    known = found.inverse > 0
    off = np.abs(1.0 / np.maximum(found.inverse, 1e-6) - depth)[known] / depth[known]
    assert (off < 0.02).mean() > 0.93
    assert known[depth < 2].mean() > 0.6


@pytest.mark.parametrize("size", [64, 160])
def test_depth_maps_have_the_size_asked_for(size: int) -> None:
    view, others, depth = _views([SLANTED])
    small, sources = (
        multi_view_stereo._shrunk(view, size),
        [multi_view_stereo._shrunk(other, size) for other in others],
    )
    measured = measure_depth(small, sources, sources, 1.0, 6.0)
    found, sigma = multi_view_stereo._meters(measured.inverse, measured.sigma)
    assert found.shape == sigma.shape == (round(size * 0.75), size)
    there = found > 0
    assert (sigma[there] > 0).all()
    step = CAMERA.width / size
    rows, columns = (np.round((np.arange(n) + 0.5) * step - 0.5).astype(int) for n in found.shape)
    truth = depth[np.ix_(rows, columns)]
    assert np.median(np.abs(found - truth)[there] / truth[there]) < 0.02


def test_medians_are_those_of_a_plain_implementation() -> None:
    image = torch.from_numpy(np.random.default_rng(0).random((13, 18), np.float32))
    torch.testing.assert_close(filter_median(image), filter_median_reference(image))
    padded = np.pad(image.numpy(), 2, mode="edge")
    assert float(filter_median(image)[4, 0]) == np.median(padded[4:9, 0:5])


def test_nothing_is_measured_beyond_the_range() -> None:
    view, others, depth = _views([SLANTED])
    near, far = np.percentile(depth, (30, 70))
    found = measure_depth(view, others, others, near, far)
    known = found.inverse > 0
    assert ((1 / found.inverse[known] > near) & (1 / found.inverse[known] < far)).all()
    within = (depth > near) & (depth < far)
    assert (known & within).sum() > 0.5 * within.sum()
