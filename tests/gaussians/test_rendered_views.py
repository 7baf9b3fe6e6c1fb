"""How well rendered views agree with the captured ones, from given renderings."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scenes import CAMERA, gaussians, wall_frame

from freeocc3d.gaussians import rendered_views
from freeocc3d.gaussians.rasterizers.base import Rendered


class Given:
    """Renders what it was given, whatever the splats are."""

    device = torch.device("cpu")

    def __init__(self, *rendered: Rendered) -> None:
        self.rendered, self.asked = list(rendered), []

    def render(self, splats, T_cam_world, camera) -> Rendered:
        self.asked.append((splats, T_cam_world, camera))
        return self.rendered.pop(0)


def captured(depth_m: np.ndarray, gray: int = 102) -> rendered_views.CapturedView:
    """A small gray view, two meters from the origin."""
    T = torch.eye(4)
    T[2, 3] = 2.0
    color = torch.full((*depth_m.shape, 3), gray, dtype=torch.uint8)
    return rendered_views.CapturedView(color, torch.from_numpy(np.float32(depth_m)), T, CAMERA)


def test_fidelity_is_measured_where_there_is_depth_and_something_rendered() -> None:
    depth = np.array([(2.0, 2.0, 2.0, 2.0), (0.0, 0.0, 0.0, 0.0)])
    alpha = torch.tensor([(1.0, 0.5, 0.49, 0.0), (1.0, 1.0, 0.0, 0.0)])
    shown = torch.tensor([(2.1, 1.7, 9.0, 9.0), (9.0, 9.0, 9.0, 9.0)])
    image = torch.full((2, 4, 3), 0.4)
    image[0] += 0.1
    image[1, :, 0] = 0.7
    image[1, :, 1:] = torch.tensor((0.4, 0.4))
    rasterizer = Given(Rendered(image, shown * alpha, alpha))
    cloud = gaussians((0.0, 0.0, 2.0), 0.1)
    found = rendered_views.measure_fidelity(cloud, [captured(depth)], rasterizer)
    assert found.psnr_measured == pytest.approx(20.0, abs=1e-3)  # off by a tenth everywhere
    assert found.psnr == pytest.approx(-10 * np.log10((0.01 + 0.03) / 2), abs=1e-3)
    assert found.depth_l1_m == pytest.approx((0.1 + 0.3) / 2, abs=1e-5)
    assert found.covered == pytest.approx(0.5)
    ((splats, T, camera),) = rasterizer.asked
    torch.testing.assert_close(splats.colors, torch.full((1, 3), 128 / 255))
    torch.testing.assert_close(splats.means, torch.tensor([(0.0, 0.0, 2.0)]))
    assert float(T[2, 3]) == 2.0
    assert camera is CAMERA


def test_views_are_averaged_and_those_that_say_nothing_are_left_out() -> None:
    bright = Rendered(torch.full((2, 4, 3), 2.0), torch.full((2, 4), 3.0), torch.ones((2, 4)))
    nothing = Rendered(torch.full((2, 4, 3), 0.4), torch.zeros((2, 4)), torch.zeros((2, 4)))
    views = [captured(np.full((2, 4), 2.5), gray=255), captured(np.zeros((2, 4)))]
    found = rendered_views.measure_fidelity(gaussians((0.0, 0.0, 2.0), 0.1), views, Given(bright, nothing))
    assert found.psnr == pytest.approx(100.0, abs=0.5)  # more than white is white; errors below 1e-10 count as that
    assert found.depth_l1_m == pytest.approx(0.5)
    assert found.covered == 1.0
    none = rendered_views.measure_fidelity(gaussians((0.0, 0.0, 2.0), 0.1), views[1:], Given(nothing))
    assert (none.depth_l1_m, none.covered, none.psnr_measured) == (None, None, None)


def test_a_frame_that_is_reduced_keeps_its_shape_and_its_depths() -> None:
    frame = wall_frame(2.0)
    frame.depth_m[::2] = 3.0
    T = np.eye(4)
    T[:3, 3] = 1.0, 2.0, 3.0
    view = rendered_views.prepare_captured_view(frame, T, 64, torch.device("cpu"))
    assert (view.camera.width, view.camera.height) == (64, 48)
    assert view.color.shape == (48, 64, 3)
    assert set(view.depth_m.unique().tolist()) <= {2.0, 3.0}
    torch.testing.assert_close(view.T_cam_world[:3, 3], torch.tensor((-1.0, -2.0, -3.0)))
    assert rendered_views.prepare_captured_view(frame, T, 160, torch.device("cpu")).camera == CAMERA


def test_a_halved_view_is_as_a_frame_reduced_to_that_width() -> None:
    frame = wall_frame(2.0)
    whole, half = (rendered_views.prepare_captured_view(frame, np.eye(4), w, torch.device("cpu")) for w in (160, 80))
    found = rendered_views.halve_view(whole)
    assert found.camera == half.camera
    torch.testing.assert_close(found.color, half.color)
    torch.testing.assert_close(found.depth_m, half.depth_m)
