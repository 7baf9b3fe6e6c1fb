"""gsplat's CUDA kernels; they need an NVIDIA GPU and ``pip install freeocc3d[gsplat]``."""

from __future__ import annotations

import torch
from torch import Tensor

from ...core.errors import DependencyError
from ...core.types import Intrinsics
from ...settings.option_types import Device
from ...settings.typed_options import TypedOptions
from .base import BLUR, NEAR, Rendered, Splats

REQUIRES = ("gsplat",)


class Options(TypedOptions, frozen=True):
    """The device."""

    device: Device = "cuda:0"
    """A CUDA device of torch, such as "cuda:0"."""


class GsplatRasterizer:
    """Source: V. Ye et al., gsplat: An Open-Source Library for Gaussian Splatting, JMLR 2025."""

    def __init__(self, device: str):
        self.device = torch.device(device)

    def render(self, splats: Splats, T_cam_world: Tensor, camera: Intrinsics) -> Rendered:
        """See ``base.Rasterizer``."""
        from gsplat import rasterization

        # gsplat puts pixel centers at halves; here they are at integers.
        K = torch.tensor(
            ((camera.fx, 0.0, camera.cx + 0.5), (0.0, camera.fy, camera.cy + 0.5), (0.0, 0.0, 1.0)), device=self.device
        )
        out, alpha, _ = rasterization(
            means=splats.means,
            quats=splats.quats_wxyz,
            scales=splats.scales,
            opacities=splats.opacities,
            colors=splats.colors,
            viewmats=T_cam_world[None],
            Ks=K[None],
            width=camera.width,
            height=camera.height,
            near_plane=NEAR,
            eps2d=BLUR,
            render_mode="RGB+D",
        )
        return Rendered(out[0, ..., :3], out[0, ..., 3], alpha[0, ..., 0])


def load(options: Options) -> GsplatRasterizer:
    """Makes the rasterizer on a CUDA device. Raises DependencyError if there is none."""
    if not torch.cuda.is_available():
        raise DependencyError(
            "The rasterizer 'gsplat' needs an NVIDIA GPU and a torch built for CUDA: use fitting.rasterizer=cpu."
        )
    return GsplatRasterizer(options.device)
