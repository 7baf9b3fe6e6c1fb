"""The keyframes, at rendering size, that Gaussians are fitted to and compared with."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..core.transforms import invert
from ..core.types import Frame, Gaussians, Intrinsics
from .rasterizers.base import Rasterizer, Rendered, Splats


@dataclass(frozen=True)
class CapturedView:
    """A keyframe: color (H, W, 3) uint8 RGB, depth_m (H, W) float32 (0: none), T_cam_world (4, 4) float32, camera."""

    color: Tensor
    depth_m: Tensor
    T_cam_world: Tensor
    camera: Intrinsics

    @property
    def image(self) -> Tensor:
        """(H, W, 3) float32 in 0…1."""
        return self.color.to(torch.float32) / 255

    @property
    def measured(self) -> Tensor:
        """(H, W) bool, where depth was measured."""
        return self.depth_m > 0


def prepare_captured_view(
    frame: Frame, T_world_cam: NDArray[np.float64], width: int, device: torch.device
) -> CapturedView:
    """Reduces a frame to ``width`` columns if it has more. Color is averaged. Depth is picked, because an average
    across an edge is on no surface."""
    camera, color, depth_m = frame.intrinsics, frame.color, frame.depth_m
    if camera.width > width:
        size = width, max(1, round(camera.height * width / camera.width))
        camera = camera.resized(*size)
        color = cv2.resize(color, size, interpolation=cv2.INTER_AREA)
        depth_m = cv2.resize(depth_m, size, interpolation=cv2.INTER_NEAREST_EXACT)
    T_cam_world = torch.from_numpy(invert(T_world_cam).astype(np.float32))
    return CapturedView(
        torch.from_numpy(np.ascontiguousarray(color)).to(device),
        torch.from_numpy(np.ascontiguousarray(depth_m)).to(device),
        T_cam_world.to(device),
        camera,
    )


def halve_view(view: CapturedView) -> CapturedView:
    """The view at half its size, as ``prepare_captured_view`` reduces frames."""
    camera, device = view.camera, view.color.device
    size = max(1, camera.width // 2), max(1, camera.height // 2)
    color = cv2.resize(view.color.cpu().numpy(), size, interpolation=cv2.INTER_AREA)
    depth_m = cv2.resize(view.depth_m.cpu().numpy(), size, interpolation=cv2.INTER_NEAREST_EXACT)
    return CapturedView(
        torch.from_numpy(color).to(device),
        torch.from_numpy(depth_m).to(device),
        view.T_cam_world,
        camera.resized(*size),
    )


def render_gaussians(gaussians: Gaussians, view: CapturedView, rasterizer: Rasterizer) -> Rendered:
    """Renders the Gaussians from the view's camera; not differentiable."""
    arrays = gaussians.means, gaussians.scales, gaussians.quats_wxyz, gaussians.opacities, gaussians.colors / 255.0
    tensors = (torch.from_numpy(np.ascontiguousarray(array, np.float32)).to(rasterizer.device) for array in arrays)
    with torch.no_grad():
        return rasterizer.render(Splats(*tensors), view.T_cam_world, view.camera)


@dataclass(frozen=True)
class Fidelity:
    """How well rendered views agree with the captured ones: means over the views (None: in no view).

    psnr: dB over all pixels.  psnr_measured: dB over the pixels that have a depth, which is where anchors are.
    depth_l1_m: mean |D / alpha - d| over the pixels that have a depth and alpha >= 1/2, meters.
    covered: share of the pixels with a depth that have alpha >= 1/2.
    """

    psnr: float | None
    psnr_measured: float | None
    depth_l1_m: float | None
    covered: float | None


def measure_fidelity(gaussians: Gaussians, views: Sequence[CapturedView], rasterizer: Rasterizer) -> Fidelity:
    """Renders each view and compares it with the captured one."""
    rows = [_fidelity(render_gaussians(gaussians, view, rasterizer), view) for view in views]
    if not rows:
        return Fidelity(None, None, None, None)
    columns = np.array(rows, np.float64).T
    return Fidelity(*(float(np.nanmean(column)) if np.isfinite(column).any() else None for column in columns))


def _fidelity(rendered: Rendered, view: CapturedView) -> tuple[float, float, float, float]:
    squared = ((rendered.image.clamp(0, 1) - view.image) ** 2).mean(dim=2)
    measured = view.measured
    solid = measured & (rendered.alpha >= 0.5)
    depth = rendered.depth / rendered.alpha.clamp(min=1e-6)
    return (
        _decibels(squared),
        _decibels(squared[measured]),
        float((depth - view.depth_m)[solid].abs().mean()),
        float(solid[measured].to(torch.float32).mean()),
    )


def _decibels(squared: Tensor) -> float:
    return float(-10 * torch.log10(squared.mean().clamp(min=1e-10))) if len(squared) else float("nan")
