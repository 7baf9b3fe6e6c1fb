"""Depth that other views confirm, on exact and on wrong depths."""

import numpy as np
import pytest
from textured import CAMERA, Rectangle, looking, render

from freeocc3d.depth.cross_view_check import DepthImage, confirm_depth

ROOM = [Rectangle((-3, -3, 3.0), (6, 0, 0), (0, 6, 0)), Rectangle((-0.3, -0.4, 1.5), (0.6, 0, 0), (0, 0.8, 0), seed=1)]


def _depth(x: float, scale: float = 1.0) -> DepthImage:
    _, depth = render(ROOM, looking(x, toward=3.0))
    inverse = (1.0 / (depth * scale)).astype(np.float32)
    return DepthImage(inverse, np.full_like(inverse, 1e-3), CAMERA, looking(x, toward=3.0))


def test_true_depths_confirm_each_other_where_both_see() -> None:
    own = _depth(0.0)
    found = confirm_depth(own, [_depth(0.3), _depth(-0.3)], tolerance=0.01)
    assert (found.agreeing == 2).float().mean() > 0.7
    assert (found.agreeing >= 1).float().mean() > 0.93  # what the box hides from one, the other sees
    assert (found.through > 0).float().mean() < 0.02
    np.testing.assert_allclose(found.inverse.numpy(), own.inverse, rtol=0.01)


def test_a_wrong_depth_is_not_confirmed() -> None:
    found = confirm_depth(_depth(0.0, scale=0.9), [_depth(0.3), _depth(-0.3)], tolerance=0.01)
    assert (found.agreeing > 0).float().mean() < 0.05
    assert (found.through == 2).float().mean() > 0.6  # it is nearer than what the others see


def test_pixels_without_depth_neither_confirm_nor_refute() -> None:
    own, other = _depth(0.0), _depth(0.3)
    empty = DepthImage(np.zeros_like(other.inverse), other.sigma, CAMERA, other.T_world_cam)
    found = confirm_depth(own, [empty], tolerance=0.01)
    assert not found.agreeing.any()
    assert not found.through.any()


def test_mean_of_what_agrees_and_its_spread() -> None:
    own, near = _depth(0.0), _depth(0.001, scale=1.008)
    found = confirm_depth(own, [near], tolerance=0.02)
    middle = found.inverse.numpy()[60, 10], own.inverse[60, 10]
    assert middle[0] == pytest.approx(middle[1] / 1.004, rel=5e-4)
    assert float(found.sigma[60, 10]) >= 1e-3  # no surer than one: errors are shared
