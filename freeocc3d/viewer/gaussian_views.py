"""Draws the Gaussians of a map as the camera of a picture sees them."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from ..core.types import Gaussians
from ..gaussians.rasterizers.base import Splats
from ..gaussians.rasterizers.cpu import CpuRasterizer
from .scene_rendering import BACKGROUND, ViewCamera


class GaussianPainter:
    """Keeps what all views of the same Gaussians need. R_scene_map: (3, 3) from their frame to the scene's."""

    def __init__(self, gaussians: Gaussians, R_scene_map: NDArray[np.float64]):
        arrays = gaussians.means, gaussians.scales, gaussians.quats_wxyz, gaussians.opacities, gaussians.colors / 255.0
        self._splats = Splats(*(torch.from_numpy(np.ascontiguousarray(array, np.float32)) for array in arrays))
        self._rasterizer = CpuRasterizer()
        self._T_scene_map = np.eye(4)
        self._T_scene_map[:3, :3] = R_scene_map

    def draw(self, camera: ViewCamera) -> NDArray[np.uint8]:
        """Returns the (H, W, 3) RGB."""
        T_cam_map = torch.from_numpy((camera.T_cam_scene @ self._T_scene_map).astype(np.float32))
        with torch.no_grad():
            rendered = self._rasterizer.render(self._splats, T_cam_map, camera.intrinsics)
        behind = (1 - rendered.alpha.numpy()[..., None]) * BACKGROUND
        return np.rint(np.clip(255 * rendered.image.numpy() + behind, 0, 255)).astype(np.uint8)
