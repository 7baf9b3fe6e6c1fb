"""The contract of a rasterizer, and the constants of alpha compositing that all rasterizers share.

A rasterizer is one file of this folder with ``load() -> Rasterizer``, or ``load(options)`` if it has ``Options``. It
renders N Gaussians (paper, Eq. render) as

    Sigma_2 = J R Sigma R^T J^T + BLUR I,   J the derivative of the projection at the mean
    alpha_k(u) = min(ALPHA_MAX, o_k exp(-1/2 (u - u_k)^T Sigma_2^-1 (u - u_k))), nothing below ALPHA_MIN
    w_k = alpha_k prod_{j<k} (1 - alpha_j), nearest mean first, until the product falls to TRANSMITTANCE_MIN
    image = sum_k w_k c_k,   depth = sum_k w_k z_k,   alpha = sum_k w_k              (paper, Eq. ray_comp)

with z_k the mean's camera-frame z. Depth is not divided by alpha.

Source: B. Kerbl et al., 3D Gaussian Splatting, SIGGRAPH 2023. The constants are gsplat's, so that all rasterizers
agree.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple, Protocol

from ...core.types import Intrinsics

if TYPE_CHECKING:  # kernels take their constants from here, and are compiled where there is no torch
    import torch
    from torch import Tensor

BLUR = 0.3
"""Variance in pixels^2 that is added to every splat, so that none is smaller than a pixel."""
ALPHA_MIN, ALPHA_MAX = 1.0 / 255.0, 0.999
TRANSMITTANCE_MIN = 1e-4
NEAR = 0.01
"""Meters; Gaussians with nearer means are not drawn."""
BEYOND = 0.15
"""J is evaluated at the mean up to this share of the image's width and height beyond each edge. For means beyond that
limit it is evaluated at the limit, where the linear projection is still valid."""


class Rendered(NamedTuple):
    """image (H, W, 3) on a black background, depth (H, W) meters times alpha, alpha (H, W); float32."""

    image: Tensor
    depth: Tensor
    alpha: Tensor


class Splats(NamedTuple):
    """The input of a rasterizer for N Gaussians, float32 on its device.

    means (N, 3) world meters, scales (N, 3) meters, quats_wxyz (N, 4) of any length but 0, opacities (N,) and colors
    (N, 3) in 0…1.
    """

    means: Tensor
    scales: Tensor
    quats_wxyz: Tensor
    opacities: Tensor
    colors: Tensor


class Rasterizer(Protocol):
    """Renders on ``device``, differentiably in all arrays of the splats."""

    device: torch.device

    def render(self, splats: Splats, T_cam_world: Tensor, camera: Intrinsics) -> Rendered:
        """Renders the image of ``camera``. T_cam_world: (4, 4) float32 on ``device``."""
        ...


def compute_slope_limits(camera: Intrinsics) -> tuple[float, float, float, float]:
    """The smallest and largest x/z, then y/z, at which J is evaluated (``BEYOND``)."""
    beside, above = BEYOND * camera.width / camera.fx, BEYOND * camera.height / camera.fy
    return (
        -(camera.cx + 0.5) / camera.fx - beside,
        (camera.width - camera.cx - 0.5) / camera.fx + beside,
        -(camera.cy + 0.5) / camera.fy - above,
        (camera.height - camera.cy - 0.5) / camera.fy + above,
    )
