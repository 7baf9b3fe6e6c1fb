"""Draws the Gaussians of a map as the camera of a picture sees them."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from ..core.types import Gaussians
from ..gaussians.rasterizers.base import Splats
from ..gaussians.rasterizers.cpu import CpuRasterizer
from .scene_rendering import BACKGROUND, BOX_EDGES, NEAR_M, DrawnBox, ViewCamera
from .view_cameras import pixels_of


class GaussianPainter:
    """Keeps what all views of the same Gaussians need. R_scene_map: (3, 3) from their frame to the scene's."""

    def __init__(self, gaussians: Gaussians, R_scene_map: NDArray[np.float64]):
        arrays = gaussians.means, gaussians.scales, gaussians.quats_wxyz, gaussians.opacities, gaussians.colors / 255.0
        self._splats = Splats(*(torch.from_numpy(np.ascontiguousarray(array, np.float32)) for array in arrays))
        self._rasterizer = CpuRasterizer()
        self._T_scene_map = np.eye(4)
        self._T_scene_map[:3, :3] = R_scene_map

    def draw(self, camera: ViewCamera, boxes: Sequence[DrawnBox] = ()) -> NDArray[np.uint8]:
        """Returns the (H, W, 3) RGB, with the edges of the boxes over it."""
        T_cam_map = torch.from_numpy((camera.T_cam_scene @ self._T_scene_map).astype(np.float32))
        with torch.no_grad():
            rendered = self._rasterizer.render(self._splats, T_cam_map, camera.intrinsics)
        behind = (1 - rendered.alpha.numpy()[..., None]) * BACKGROUND
        image = np.rint(np.clip(255 * rendered.image.numpy() + behind, 0, 255)).astype(np.uint8)
        for box in boxes:
            _draw_edges(image, box, camera)
        return image


def _draw_edges(image: NDArray[np.uint8], box: DrawnBox, camera: ViewCamera) -> None:
    height, width = image.shape[:2]
    _, depth = pixels_of(box.corners, camera)
    for a, b in BOX_EDGES:
        ends = box.corners[[a, b]]
        if depth[[a, b]].max() <= NEAR_M:
            continue
        if depth[[a, b]].min() < NEAR_M:  # moves the end that is behind the camera to just before it
            share = (NEAR_M - depth[a]) / (depth[b] - depth[a])
            ends[int(depth[a] > depth[b])] = ends[0] + share * (ends[1] - ends[0])
        places = pixels_of(ends, camera)[0]
        if np.abs(places).max() > 30_000:  # OpenCV's lines have 16 bits before the point
            continue
        inside, start, end = cv2.clipLine((0, 0, width, height), *np.rint(places).astype(int).tolist())
        if inside:
            cv2.line(image, start, end, box.color, 2, cv2.LINE_AA)
