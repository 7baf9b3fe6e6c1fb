"""Dense depth of one view from the views around it, by plane sweep and refinement."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from .cross_view_check import DepthImage
from .photo_consistency import Matcher, StereoView
from .semi_global import aggregate_costs, price_jumps

_FEWEST, _MOST_HYPOTHESES = 32, 160  # limits on the inverse depths of a sweep, which has one per pixel of disparity
_CONTRAST = 4.0 / 255.0  # a larger change of gray may be an object's edge
_STEP, _JUMPS = 0.05, (0.3, 1.2)  # in units of 1 - correlation
_RADIUS, _FINE_RADIUS = 2, 3  # pixels on each side of a patch's center
_LEAST_SWEPT = 160  # pixels of the longer side: smaller images lose texture
_REFINED = (1.0, 0.5)  # pixels between hypotheses around the current depth
_LEAST_SCORE = 0.5  # smallest correlation of a match
_SUREST, _UNSURE = 0.25, 1.0  # pixels: smallest sigma of a match, and largest
_STEADY = 1.5  # largest last step of the refinement, pixels
_MEDIAN = 5  # edge of the window of a median, pixels
_DEPENDENT = 4.0  # pixels per independent measurement: neighboring pixels of a resampled image are not independent
_FARTHEST = 1e-4  # 1 / meters: smallest inverse depth of a hypothesis
_TINY_MISMATCH, _TINY_CURVATURE, _FLAT = 1e-3, 1e-6, 1e-5
"""Smallest 1 - correlation and smallest curvature for sigma; a curve with less than the last curvature has no
maximum."""


def sweep_planes(view: StereoView, others: Sequence[StereoView], near: float, far: float, device: str) -> Tensor:
    """(H, W) inverse depths of a small view, by plane sweep over near…far meters and semi-global aggregation."""
    matcher = Matcher(view, others, _RADIUS, device)
    least, most = 1.0 / far, 1.0 / near
    count = int(np.clip(np.ceil((most - least) / matcher.pixel), _FEWEST, _MOST_HYPOTHESES))
    hypotheses = torch.linspace(least, most, count, device=matcher.device)
    costs = (1.0 - matcher.agreement(hypotheses[:, None, None])).permute(1, 2, 0).contiguous()
    totals = aggregate_costs(costs, _STEP, *price_jumps(matcher.gray, *_JUMPS, _CONTRAST))
    best = totals.argmin(dim=-1, keepdim=True).clamp(1, count - 2)
    shift, _ = _vertex(*(-totals.gather(-1, best + k)[..., 0] for k in (-1, 0, 1)))
    return least + (best[..., 0] + shift.clamp(-0.5, 0.5)) * ((most - least) / (count - 1))


def measure_depth(
    view: StereoView,
    others: Sequence[StereoView],
    apart: Sequence[StereoView],
    near: float,
    far: float,
    device: str = "cpu",
) -> DepthImage:
    """Measure inverse depths where patches match well and unambiguously; 0 elsewhere.

    Matches are found among ``others``, first in images of a quarter of the size (of half for small images), then of
    twice that size. They are refined among the views ``apart``, which have longer baselines.

    sigma: for n independent pixels, correlation c at the peak and curvature 2 k, the least-squares estimate has the
    variance (1 - c) / (n k). The smallest sigma is a quarter of a pixel.
    """
    camera = view.intrinsics
    longer = max(camera.width, camera.height)
    first = min(longer / 2, max(longer / 4, _LEAST_SWEPT)) / longer
    coarse = sweep_planes(_scaled(view, first), [_scaled(other, first) for other in others], near, far, device)
    second = 2.0 * first
    finder = Matcher(_scaled(view, second), [_scaled(other, second) for other in others], _RADIUS, device)
    inverse = _all_refined(finder, coarse)[0]
    matcher = Matcher(view, apart, _FINE_RADIUS, device)
    inverse, before, score, sigma = _all_refined(matcher, inverse)
    sure = (score > _LEAST_SCORE) & (sigma < _UNSURE * matcher.pixel)
    sure &= ((inverse - before).abs() < _STEADY * matcher.pixel) & (inverse > 1.0 / far) & (inverse < 1.0 / near)
    sigma = torch.sqrt(sigma.square() + (_SUREST * matcher.pixel) ** 2)
    return DepthImage(_array(inverse * sure), _array(sigma), camera, view.T_world_cam)


def filter_median(image: Tensor) -> Tensor:
    """(H, W) median over 5 x 5 pixels."""
    if image.device.type == "cpu":
        return torch.from_numpy(cv2.medianBlur(image.numpy(), _MEDIAN))
    return filter_median_reference(image)


def filter_median_reference(image: Tensor) -> Tensor:
    """``filter_median`` by torch, on any device."""
    padded = F.pad(image[None, None], (_MEDIAN // 2,) * 4, mode="replicate")
    return F.unfold(padded, _MEDIAN).median(dim=1)[0].view(image.shape)


def _scaled(view: StereoView, by: float) -> StereoView:
    camera = view.intrinsics
    return view.shrunk(round(camera.width * by), round(camera.height * by))


def _all_refined(matcher: Matcher, inverse: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Refine inverse depths of a smaller image. Returns them, those before the last step, scores, and sigmas."""
    inverse = F.interpolate(filter_median(inverse)[None, None], matcher.gray.shape, mode="bilinear")[0, 0]
    before = score = sigma = inverse
    for pixels in _REFINED:
        before = filter_median(inverse)
        inverse, score, sigma = _refined(matcher, before, pixels * matcher.pixel)
    return inverse, before, score, sigma


def _refined(matcher: Matcher, inverse: Tensor, step: float) -> tuple[Tensor, Tensor, Tensor]:
    """The best inverse depth near ``inverse``, its score, and its standard deviation."""
    offsets = torch.arange(-2, 3, device=inverse.device) * step
    scores = matcher.scores((inverse + offsets[:, None, None]).clamp_min(_FARTHEST))
    count = (len(scores) + 1) // 2
    best_views = scores.amax(dim=1).topk(count, dim=0)[1]  # the same views for all hypotheses, or the curve has steps
    curve = scores.gather(0, best_views[:, None].expand(-1, len(offsets), -1, -1)).mean(dim=0)
    best = curve.argmax(dim=0, keepdim=True).clamp(1, len(offsets) - 2)
    before, peak, after = (curve.gather(0, best + k)[0] for k in (-1, 0, 1))
    shift, curvature = _vertex(before, peak, after)
    patch = (2 * matcher.radius + 1) ** 2 * count / _DEPENDENT
    sigma = step * torch.sqrt(
        (1.0 - peak).clamp_min(_TINY_MISMATCH) / (patch * 0.5 * curvature.clamp_min(_TINY_CURVATURE))
    )
    return inverse + (best[0] - 2 + shift.clamp(-1.0, 1.0)) * step, peak, sigma


def _vertex(before: Tensor, peak: Tensor, after: Tensor) -> tuple[Tensor, Tensor]:
    """Position of the maximum of the parabola through three values at -1, 0, 1 (0 if none), and 2 peak - before -
    after."""
    curvature = 2.0 * peak - before - after
    return torch.where(curvature > _FLAT, 0.5 * (after - before) / curvature.clamp_min(_FLAT), 0.0), curvature


def _array(values: Tensor) -> NDArray[np.float32]:
    return np.asarray(values.float().cpu().numpy())
