"""Compiled for CPUs: tiles, sorted splats, forward and backward pass on all cores."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ...core.types import Intrinsics
from ..splat_projection import Z, project_backward, project_splats
from ..tile_compositing import TILE, composite, composite_backward, list_by_tile, sort_nearest_first
from .base import Rendered, Splats, compute_slope_limits

REQUIRES: tuple[str, ...] = ()

Array = NDArray[np.float32]


class CpuRasterizer:
    """Sorts splats by depth once, then lists them by the tiles that they reach. It composites each tile nearest first
    until the tile is opaque. The backward pass composites again.

    Memory: 44 bytes per splat in view, 8 per splat and tile, and for the backward pass 40 per splat and tile."""

    def __init__(self) -> None:
        self.device = torch.device("cpu")

    def render(self, splats: Splats, T_cam_world: Tensor, camera: Intrinsics) -> Rendered:
        """See ``base.Rasterizer``."""
        out = _Render.apply(*splats, T_cam_world, camera)
        return Rendered(out[..., :3], out[..., 3], out[..., 4])


class _Render(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *arguments: Any) -> Tensor:
        means, scales, quats, opacities, colors = (_array(tensor) for tensor in arguments[:5])
        T, camera = _array(arguments[5]), arguments[6]
        pinhole = np.array((camera.fx, camera.fy, camera.cx, camera.cy), np.float32)
        limits = np.array(compute_slope_limits(camera), np.float32)
        splats, box = project_splats(
            means, scales, quats, opacities, colors, T, pinhole, limits, camera.width, camera.height
        )
        rows = np.flatnonzero(box[:, 0] <= box[:, 1])
        rows = sort_nearest_first(rows, splats[rows, Z].view(np.uint32))
        splats, box = splats[rows], box[rows]
        start, listed, first, places = list_by_tile(box, -(-camera.width // TILE), -(-camera.height // TILE))
        out = composite(splats, box, start, listed, camera.width, camera.height)
        ctx.saved = (means, scales, quats, T, pinhole, limits, rows, splats, box, start, listed, first, places, out)
        return torch.from_numpy(out)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        means, scales, quats, T, pinhole, limits, rows, splats, box, start, listed, first, places, out = ctx.saved
        by_tile = composite_backward(splats, box, start, listed, out, _array(gradient))
        found = project_backward(means, scales, quats, T, pinhole, limits, rows, by_tile, first, places)
        return *(torch.from_numpy(array) for array in found), None, None


def _array(tensor: Tensor) -> Array:
    return np.ascontiguousarray(tensor.detach().numpy(), np.float32)


def load() -> CpuRasterizer:
    """Makes the rasterizer."""
    return CpuRasterizer()
