"""Photo-consistency: how well other views agree with hypothetical depths of a reference view's pixels.

All depths are inverse depths: with equal steps of inverse depth, a pixel moves nearly evenly through the other images,
and on a plane inverse depth is linear in the pixel. Source: R. T. Collins, A Space-Sweep Approach to True Multi-Image
Matching, CVPR 1996.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from ..core.transforms import invert
from ..core.types import Intrinsics

NOISE = 3.0 / 255.0
"""Standard deviation of the difference of two images of one surface. Weaker texture gets a low score."""

_AT_ONCE = {"cpu": 1 << 17, "cuda": 1 << 24}  # pixels x hypotheses; on a CPU they fit in its cache


@dataclass(frozen=True)
class StereoView:
    """An image with a known camera.

    color: (H, W, 3) uint8 RGB, or (H, W) float32 gray in 0…1 for ``intrinsics`` of that size.
    T_world_cam: (4, 4) float64.
    """

    color: NDArray[np.uint8] | NDArray[np.float32]
    intrinsics: Intrinsics
    T_world_cam: NDArray[np.float64]

    def shrunk(self, width: int, height: int) -> StereoView:
        """The same view in gray, at another size."""
        image = self.color
        if image.ndim == 3:
            image = np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32) / np.float32(255.0))
        if image.shape != (height, width):
            image = np.asarray(cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA), np.float32)
        return StereoView(image, self.intrinsics.resized(width, height), self.T_world_cam)


def compute_rays(camera: Intrinsics, device: str | torch.device = "cpu") -> Tensor:
    """(3, H, W) points at depth 1 on the rays of the pixels."""
    v, u = torch.meshgrid(torch.arange(camera.height), torch.arange(camera.width), indexing="ij")
    x, y = (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy
    return torch.stack((x, y, torch.ones_like(x))).float().to(device)


class Matcher:
    """Compares a reference view with V other views, all gray and of one size.

    It compares patches of (2 radius + 1)² pixels by zero-mean normalized cross-correlation. Each pixel of a patch has
    its own depth hypothesis, so a patch can be slanted or curved.
    """

    def __init__(self, view: StereoView, others: Sequence[StereoView], radius: int, device: str = "cpu"):
        self.camera, self.radius, self.device = view.intrinsics, radius, torch.device(device)
        self.gray = self._image(view)
        self.rays = compute_rays(view.intrinsics, self.device)
        self._mean = average_box(self.gray[None], radius)[0]
        self._variance = average_box(self.gray[None] ** 2, radius)[0] - self._mean**2
        self._sources = [(self._image(other), *self._projection(view, other)) for other in others]
        baselines = [np.linalg.norm((invert(o.T_world_cam) @ view.T_world_cam)[:3, 3]) for o in others]
        self.pixel = 1.0 / (self.camera.fx * float(np.median(baselines)))
        """Step of inverse depth that moves a point by about one pixel in the other views."""

    def scores(self, inverse_depth: Tensor) -> Tensor:
        """Correlations, -1…1, of the reference with each view; 0 where the view does not see the point.

        inverse_depth: (D, H, W) or (D, 1, 1) hypotheses.  Returns (V, D, H, W).
        """
        depths = len(inverse_depth)
        out = self.gray.new_empty((len(self._sources), depths, *self.gray.shape))
        chunk = max(1, _AT_ONCE[self.device.type] // self.gray.numel())
        for at in range(0, depths, chunk):
            for row, source in enumerate(self._sources):
                out[row, at : at + chunk] = self._correlation(*source, inverse_depth[at : at + chunk])
        return out

    def agreement(self, inverse_depth: Tensor) -> Tensor:
        """(D, H, W) mean of the better half of the views' scores, so that occlusion in some views does not count.

        Source: S. B. Kang, R. Szeliski, J. Chai, Handling Occlusions in Dense Multi-view Stereo, CVPR 2001.
        """
        chunk = max(1, _AT_ONCE[self.device.type] // self.gray.numel())
        parts = [average_best_half(self.scores(part)) for part in inverse_depth.split(chunk)]
        return torch.cat(parts)

    def _correlation(self, image: Tensor, turn: Tensor, shift: Tensor, inverse_depth: Tensor) -> Tensor:
        x, y, z = turn[:, None] + inverse_depth[None] * shift  # (3, D, H, W)
        z = z.clamp_min(1e-6)
        grid = torch.stack((x / z, y / z), dim=-1)
        inside = grid.abs().amax(dim=-1) <= 1.0
        depths, height, width = inside.shape
        flat = grid.view(1, depths * height, width, 2)
        warped = F.grid_sample(image[None, None], flat, padding_mode="border", align_corners=False)
        warped = warped.view(depths, height, width)
        mean = average_box(warped, self.radius)
        variance = (average_box(warped * warped, self.radius) - mean * mean).clamp_min(0.0)
        shared = average_box(warped * self.gray, self.radius) - mean * self._mean
        scores = shared * torch.rsqrt((variance + NOISE**2) * (self._variance.clamp_min(0.0) + NOISE**2))
        return scores * inside

    def _image(self, view: StereoView) -> Tensor:
        return torch.from_numpy(view.color).to(self.device) - 0.5  # makes sums of squares more accurate

    def _projection(self, view: StereoView, other: StereoView) -> tuple[Tensor, Tensor]:
        """(3, H, W) a and (3, 1, 1, 1) b: a + inverse depth * b is the homogeneous position in the other image, with
        borders at -1 and 1."""
        camera = other.intrinsics
        to_grid = np.array(
            [[2.0 / camera.width, 0.0, 1.0 / camera.width - 1.0], [0.0, 2.0 / camera.height, 1.0 / camera.height - 1.0],
             [0.0, 0.0, 1.0]]
        )  # fmt: skip
        T_other_cam = invert(other.T_world_cam) @ view.T_world_cam
        P = torch.from_numpy(to_grid @ camera.matrix @ T_other_cam[:3]).float().to(self.device)
        return torch.einsum("ij,jhw->ihw", P[:, :3], self.rays), P[:, 3].reshape(3, 1, 1, 1)


def average_best_half(scores: Tensor) -> Tensor:
    """Mean of the better half of the views: (V, …) to (…)."""
    count = (len(scores) + 1) // 2
    return scores.mean(dim=0) if count == len(scores) else scores.topk(count, dim=0)[0].mean(dim=0)


def average_box(images: Tensor, radius: int) -> Tensor:
    """(D, H, W) means over the (2 radius + 1)² pixels around each pixel, as far as they lie in the image."""
    if images.device.type != "cpu":
        return average_box_reference(images, radius)
    size = (2 * radius + 1,) * 2  # OpenCV sums along rows and columns: four times as fast as pooling
    inside = np.ones(images.shape[1:], np.float32)
    share = 1.0 / cv2.boxFilter(inside, -1, size, borderType=cv2.BORDER_CONSTANT)
    means = np.empty(images.shape, np.float32)
    for image, mean in zip(images.numpy(), means, strict=True):
        cv2.boxFilter(image, -1, size, dst=mean, borderType=cv2.BORDER_CONSTANT)
        mean *= share
    return torch.from_numpy(means)


def average_box_reference(images: Tensor, radius: int) -> Tensor:
    """``average_box`` by torch, on any device."""
    size = 2 * radius + 1
    rows = F.avg_pool2d(images[:, None], (1, size), 1, (0, radius), count_include_pad=False)
    return F.avg_pool2d(rows, (size, 1), 1, (radius, 0), count_include_pad=False)[:, 0]
