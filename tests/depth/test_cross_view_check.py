"""Depth that other views confirm, on exact and on wrong depths."""

import numpy as np
import pytest
from textured import CAMERA, Rectangle, looking, render

from freeocc3d.core.types import Intrinsics
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


def _plainly(view: DepthImage, others: list[DepthImage], tolerance: float, row: int, column: int):
    """What ``confirm_depth`` says of one pixel, and how near it is to saying something else."""
    inverse, sigma = float(view.inverse[row, column]), float(view.sigma[row, column])
    camera, close = view.camera, 1.0
    ray = np.array(((column - camera.cx) / camera.fx, (row - camera.cy) / camera.fy, 1.0))
    agreeing, through, said = 0, 0, [(1 / sigma**2, inverse)]
    for other in others:
        T = np.linalg.inv(other.T_world_cam) @ view.T_world_cam
        x, y, z = T[:3, :3] @ (ray / inverse) + T[:3, 3]
        u, v = x / z * other.camera.fx + other.camera.cx, y / z * other.camera.fy + other.camera.cy
        close = min(close, *(abs(at % 1 - 0.5) for at in (u, v)))
        j, i = round(u), round(v)
        if z <= 0 or not (0 <= j < other.camera.width and 0 <= i < other.camera.height) or not other.inverse[i, j]:
            continue
        there = np.array((x, y, z)) / (float(other.inverse[i, j]) * z)
        back = float((np.linalg.inv(T) @ (*there, 1.0))[2])
        moved_sigma = float(other.sigma[i, j]) * (1 / back / float(other.inverse[i, j])) ** 2
        within = max(2 * np.hypot(sigma, moved_sigma), tolerance * inverse)
        off = abs(1 / back - inverse)
        close = min(close, abs(off - within) / inverse * 10)
        if back > 0 and off <= within:
            agreeing += 1
            said.append((1 / moved_sigma**2, 1 / back))
        elif back * inverse > 1:
            through += 1
    weight, values = np.array(said).T
    mean = np.average(values, weights=weight)
    spread = np.average(values**2, weights=weight) - mean**2
    return agreeing, through, mean, np.sqrt((agreeing + 1) / weight.sum() + max(spread, 0)), close


@pytest.mark.parametrize("tolerance", [0.15, 0.002])
def test_every_pixel_says_what_the_definition_says(tolerance: float) -> None:
    rng = np.random.default_rng(0)
    images = []
    for x in (0.0, 0.5, -0.4):
        exact = _depth(x)
        inverse = exact.inverse * rng.normal(1, 0.05, exact.inverse.shape)
        inverse[rng.random(inverse.shape) < 0.1] = 0
        sigma = np.float32(rng.uniform(0.004, 0.02, inverse.shape))
        camera = Intrinsics(CAMERA.width, CAMERA.height, CAMERA.fx, 0.9 * CAMERA.fy, CAMERA.cx + 3 + x, CAMERA.cy - 2)
        images.append(DepthImage(np.float32(inverse), sigma, camera, exact.T_world_cam))
    found = confirm_depth(images[0], images[1:], tolerance)
    told = np.stack([field.numpy() for field in (found.agreeing, found.through, found.inverse, found.sigma)])
    compared = 0
    for row, column in rng.integers(0, (CAMERA.height, CAMERA.width), (1500, 2)).tolist():
        if not images[0].inverse[row, column]:
            assert told[:2, row, column].tolist() == [0, 0]
            continue
        *wanted, close = _plainly(images[0], images[1:], tolerance, row, column)
        if close > 0.01:
            np.testing.assert_allclose(told[:3, row, column], wanted[:3], rtol=1e-4)
            np.testing.assert_allclose(told[3, row, column], wanted[3], rtol=0.03)  # a difference of float32
            compared += 1
    assert compared > 1000
