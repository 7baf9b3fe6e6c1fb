"""Checks the depths of a view against the depths of other views."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..core.transforms import invert
from ..core.types import Intrinsics
from .photo_consistency import compute_rays

_TINY = 1e-6  # 1 / meters for inverse depths, meters for depths: avoids division by 0
_TINY_VARIANCE = 1e-12  # its square
_NEAREST_M = 1e-3  # smallest depth of a point; it avoids division by 0 for points behind the camera


@dataclass(frozen=True)
class DepthImage:
    """Inverse depths of a posed view. inverse: (H, W) float32, 1 / meters, 0 = none.  sigma: its standard deviation,
    (H, W) float32, 1 / meters."""

    inverse: NDArray[np.float32]
    sigma: NDArray[np.float32]
    camera: Intrinsics
    T_world_cam: NDArray[np.float64]


@dataclass(frozen=True)
class ConfirmedDepth:
    """Per pixel, (H, W). agreeing: number of views that agree.  through: number of views that look through the point.
    inverse: mean inverse depth of the agreeing views, weighted by inverse variance, 1 / meters.  sigma: its standard
    deviation, which includes the spread of the views."""

    agreeing: Tensor
    through: Tensor
    inverse: Tensor
    sigma: Tensor


def confirm_depth(
    view: DepthImage, others: Sequence[DepthImage], tolerance: float, device: str = "cpu"
) -> ConfirmedDepth:
    """Compare ``view`` with ``others``. Another view agrees if its depth, transformed to ``view``, differs by no more
    than the ``tolerance`` (relative) or two standard deviations, whichever is larger."""
    inverse, sigma = (torch.from_numpy(a).to(device) for a in (view.inverse, view.sigma))
    there = inverse > 0
    points = compute_rays(view.camera, device) / inverse.clamp_min(_TINY)
    variance = sigma.square().clamp_min(_TINY_VARIANCE)
    weight, total = 1.0 / variance, inverse / variance
    square = inverse.square() / variance
    agreeing, through = torch.zeros_like(inverse), torch.zeros_like(inverse)
    for other in others:
        T_other_view = invert(other.T_world_cam) @ view.T_world_cam
        moved = _moved(T_other_view, points)
        found, found_sigma = _sampled(other, moved, device)
        seen = there & (found > 0)
        back = _moved(invert(T_other_view), moved * (1.0 / (found * moved[2]).clamp_min(_TINY)))[2]
        ratio = back * inverse  # its depth over ours
        here = 1.0 / back.clamp_min(_NEAREST_M)
        spread = torch.sqrt(variance + (found_sigma * (here / found.clamp_min(_TINY)) ** 2) ** 2)
        within = torch.maximum(2.0 * spread, tolerance * inverse)
        agrees = seen & (back > 0) & ((here - inverse).abs() <= within)
        through += seen & ~agrees & (ratio > 1.0)
        agreeing += agrees
        own = agrees / (found_sigma * (here / found.clamp_min(_TINY)) ** 2).square().clamp_min(_TINY_VARIANCE)
        weight, total, square = weight + own, total + own * here, square + own * here.square()
    mean = total / weight
    scatter = (square / weight - mean.square()).clamp_min(0.0)
    # Neighboring views share images and their errors: the mean is no more certain than a single view.
    return ConfirmedDepth(agreeing, through, mean, torch.sqrt((agreeing + 1) / weight + scatter))


def _moved(T: NDArray[np.float64], points: Tensor) -> Tensor:
    """Transform (3, H, W) points by a rigid transform."""
    M = torch.from_numpy(T[:3]).float().to(points.device)
    return torch.einsum("ij,jhw->ihw", M[:, :3], points) + M[:, 3].reshape(3, 1, 1)


def _sampled(image: DepthImage, points: Tensor, device: str) -> tuple[Tensor, Tensor]:
    """Inverse depth and sigma of ``image`` at the nearest pixels of (3, H, W) points; inverse depth is 0 outside."""
    camera = image.camera
    z = points[2].clamp_min(_TINY)
    u = torch.round(points[0] / z * camera.fx + camera.cx)
    v = torch.round(points[1] / z * camera.fy + camera.cy)
    inside = (points[2] > _TINY) & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    place = (v.clamp(0, camera.height - 1) * camera.width + u.clamp(0, camera.width - 1)).long()
    inverse, sigma = (torch.from_numpy(a).to(device).reshape(-1)[place] for a in (image.inverse, image.sigma))
    return inverse * inside, sigma
