"""Plain PyTorch on any device: the reference for tests of the other rasterizers; too slow for whole scans."""

from __future__ import annotations

import torch
from torch import Tensor

from ...core.types import Intrinsics
from ...settings.option_types import Device
from ...settings.typed_options import TypedOptions
from .base import ALPHA_MAX, ALPHA_MIN, BLUR, NEAR, TRANSMITTANCE_MIN, Rendered, Splats, compute_slope_limits

REQUIRES: tuple[str, ...] = ()

_TILE = 16


class Options(TypedOptions, frozen=True):
    """The device."""

    device: Device = "cpu"
    """A device of torch, such as "cpu" or "cuda:0"."""


class ReferenceRasterizer:
    """Renders tile by tile to limit memory; within a tile, every Gaussian that reaches it is evaluated at every
    pixel."""

    def __init__(self, device: str = "cpu"):
        self.device = torch.device(device)

    def render(self, splats: Splats, T_cam_world: Tensor, camera: Intrinsics) -> Rendered:
        """See ``base.Rasterizer``; float64 arrays are rendered in float64."""
        means, scales, quats_wxyz, opacities, colors = splats
        center, covariance, z = project_gaussians(means, scales, quats_wxyz, T_cam_world, camera)
        with torch.no_grad():
            # alpha >= ALPHA_MIN only within this box.
            reach = torch.sqrt(2 * torch.log((opacities / ALPHA_MIN).clamp(min=1)))[:, None]
            half = reach * torch.sqrt(torch.stack((covariance[:, 0, 0], covariance[:, 1, 1]), 1)) + 1e-3
            low, high = center - half, center + half
            drawn = (z > NEAR) & (opacities >= ALPHA_MIN)
            order = torch.argsort(z, stable=True)
            order = order[drawn[order]]
        conic = torch.linalg.inv(covariance)
        values = torch.cat((colors, z[:, None], torch.ones_like(z)[:, None]), dim=1)
        rows = []
        for top in range(0, camera.height, _TILE):
            tiles = []
            for left in range(0, camera.width, _TILE):
                bottom, right = min(top + _TILE, camera.height), min(left + _TILE, camera.width)
                end = torch.tensor((right - 1, bottom - 1), device=means.device)
                start = torch.tensor((left, top), device=means.device)
                here = order[((high[order] >= start) & (low[order] <= end)).all(dim=1)]
                pixels = _list_pixels(means, top, bottom, left, right)
                tile = _composite(pixels, center[here], conic[here], opacities[here], values[here])
                tiles.append(tile.reshape(bottom - top, right - left, 5))
            rows.append(torch.cat(tiles, dim=1))
        out = torch.cat(rows)
        return Rendered(out[..., :3], out[..., 3], out[..., 4])


def _list_pixels(like: Tensor, top: int, bottom: int, left: int, right: int) -> Tensor:
    """(P, 2) pixels of a tile, row by row, of the type and device of ``like``."""
    rows = torch.arange(top, bottom, device=like.device, dtype=like.dtype)
    columns = torch.arange(left, right, device=like.device, dtype=like.dtype)
    v, u = torch.meshgrid(rows, columns, indexing="ij")
    return torch.stack((u, v), dim=-1).reshape(-1, 2)


def project_gaussians(
    means: Tensor, scales: Tensor, quats_wxyz: Tensor, T_cam_world: Tensor, camera: Intrinsics
) -> tuple[Tensor, Tensor, Tensor]:
    """Pixels (N, 2) of the means, covariances (N, 2, 2) in pixels^2, camera-frame z (N,)."""
    R = T_cam_world[:3, :3]
    x, y, z = (means @ R.T + T_cam_world[:3, 3]).unbind(1)
    safe = torch.where(z > NEAR, z, torch.ones_like(z))
    x_low, x_high, y_low, y_high = compute_slope_limits(camera)
    x_slope, y_slope = (x / safe).clamp(x_low, x_high), (y / safe).clamp(y_low, y_high)
    zero = torch.zeros_like(z)
    J = torch.stack(
        (
            torch.stack((camera.fx / safe, zero, -camera.fx * x_slope / safe), dim=1),
            torch.stack((zero, camera.fy / safe, -camera.fy * y_slope / safe), dim=1),
        ),
        dim=1,
    )
    M = J @ R @ (compute_rotations(quats_wxyz) * scales[:, None, :])
    blur = BLUR * torch.eye(2, dtype=means.dtype, device=means.device)
    center = torch.stack((camera.fx * x / safe + camera.cx, camera.fy * y / safe + camera.cy), dim=1)
    return center, M @ M.transpose(1, 2) + blur, z


def compute_rotations(quats_wxyz: Tensor) -> Tensor:
    """(N, 4) quaternions of any length to (N, 3, 3)."""
    w, x, y, z = (quats_wxyz / quats_wxyz.norm(dim=1, keepdim=True)).unbind(1)
    rows = (
        torch.stack((1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)), dim=1),
        torch.stack((2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)), dim=1),
        torch.stack((2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)), dim=1),
    )
    return torch.stack(rows, dim=1)


def _composite(pixels: Tensor, center: Tensor, conic: Tensor, opacities: Tensor, values: Tensor) -> Tensor:
    """(P, C) weighted sums of values (n, C) at (P, 2) pixels over n Gaussians, nearest first."""
    offset = pixels[:, None] - center[None]
    squared = torch.einsum("pni,nij,pnj->pn", offset, conic, offset)
    alpha = (opacities * torch.exp(-0.5 * squared)).clamp(max=ALPHA_MAX)
    alpha = torch.where(alpha >= ALPHA_MIN, alpha, torch.zeros_like(alpha))
    after = torch.cumprod(1 - alpha, dim=1)
    before = torch.cat((torch.ones_like(after[:, :1]), after[:, :-1]), dim=1)
    return torch.where(after > TRANSMITTANCE_MIN, alpha * before, torch.zeros_like(alpha)) @ values


def load(options: Options) -> ReferenceRasterizer:
    """Makes the rasterizer."""
    return ReferenceRasterizer(options.device)
