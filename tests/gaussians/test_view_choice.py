"""Views to fit to: enough of them, not more; and the Gaussians that a view shows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scenes import gaussians, lifted, wall_frame

from freeocc3d.gaussians import rendered_views, view_choice


def views(count: int, apart_m: float) -> tuple[list[rendered_views.CapturedView], list, np.ndarray]:
    """A wall two meters ahead of cameras beside each other."""
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, 0, 3] = apart_m * np.arange(count)
    frames = [wall_frame(2.0, n) for n in range(count)]
    made = [
        rendered_views.prepare_captured_view(frame, T, 160, torch.device("cpu"))
        for frame, T in zip(frames, poses, strict=True)
    ]
    return made, frames, poses


@pytest.mark.parametrize(("apart_m", "expected"), [(0.0, view_choice.TIMES), (5.0, 20)])
def test_views_of_the_same_are_taken_several_times_and_views_of_other_places_all(apart_m: float, expected: int) -> None:
    made, frames, poses = views(20, apart_m)
    chosen = view_choice.choose_views(lifted(frames, poses), made)
    assert len(chosen) == expected
    assert chosen == sorted(set(chosen))


def test_a_view_without_depth_is_never_chosen() -> None:
    made, frames, poses = views(2, 1.0)
    made[0] = replace(made[0], depth_m=torch.zeros_like(made[0].depth_m))
    assert view_choice.choose_views(lifted(frames, poses), made) == [1]


def test_what_is_shown_lies_on_the_depth_and_what_is_in_view_is_not_far_behind() -> None:
    (view,), _, _ = views(1, 0.0)
    ahead, hidden, behind, beside, touching = (0, 0, 2.0), (0, 0, 3.0), (0, 0, -2.0), (9.0, 0, 2.0), (1.3, 0, 2.0)
    cloud = gaussians([ahead, hidden, behind, beside, touching, (0, 0, 2.2), (0, 0, 1.0)], 0.05)
    assert view_choice.find_shown(cloud.means, view).tolist() == [0]
    assert view_choice.find_in_view(cloud, view).tolist() == [0, 4, 5, 6], "a Gaussian reaches farther than its mean"
    (blind,) = [replace(view, depth_m=torch.zeros_like(view.depth_m))]
    assert view_choice.find_in_view(cloud, blind).tolist() == [0, 1, 4, 5, 6], "nothing hides"
