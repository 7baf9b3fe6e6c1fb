"""Draws rendered views next to the captured ones: photograph, rendering, the sensor's depth, rendered depth."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.types import Gaussians
from ..gaussians.rasterizers.base import Rasterizer
from ..gaussians.rendered_views import CapturedView, measure_fidelity, render_gaussians
from .lettering import HEADING, LEGEND, SMALL, write_text
from .scene_rendering import BACKGROUND

SHOWN = 4
"""Most views in the picture."""
_WIDTH, _GAP, _BAR, _CAPTION = 400, 8, 56, 30
_COLUMNS = "photograph", "rendered", "measured depth", "rendered depth"


def write_render_picture(
    path: Path,
    gaussians: Gaussians,
    views: Sequence[tuple[int, CapturedView]],
    rasterizer: Rasterizer,
    capture: Path,
    metric: bool = True,
) -> None:
    """Writes a PNG with a row for each view and the number of its frame. metric: whether lengths are meters. Raises
    OSError."""
    rows = [_row(gaussians, frame, view, rasterizer, metric) for frame, view in views]
    width = len(_COLUMNS) * (_WIDTH + _GAP) + _GAP
    heading = np.full((_BAR, width, 3), BACKGROUND, np.uint8)
    write_text(
        heading, f"{capture.name}: {len(gaussians):,} Gaussians rendered as keyframes saw them", (16, 36), HEADING
    )
    names = np.full((_CAPTION, width, 3), BACKGROUND, np.uint8)
    for column, name in enumerate(_COLUMNS):
        write_text(names, name, (_GAP + column * (_WIDTH + _GAP), 20), LEGEND)
    picture = np.concatenate([heading, names, *rows])
    path.write_bytes(cv2.imencode(".png", picture[:, :, ::-1])[1].tobytes())


def _row(
    gaussians: Gaussians, frame: int, view: CapturedView, rasterizer: Rasterizer, metric: bool
) -> NDArray[np.uint8]:
    rendered = render_gaussians(gaussians, view, rasterizer)
    photograph = view.color.cpu().numpy()
    image = np.rint(255 * rendered.image.clamp(0, 1).cpu().numpy()).astype(np.uint8)
    measured = view.depth_m.cpu().numpy()
    alpha = rendered.alpha.cpu().numpy()
    depth = np.where(alpha >= 0.5, rendered.depth.cpu().numpy() / np.maximum(alpha, 1e-6), 0)
    both = np.concatenate((measured[measured > 0], depth[depth > 0]))
    low, high = np.percentile(both, (1, 99)) if len(both) else (0.0, 1.0)
    panels = [photograph, image, _colored(measured, low, high), _colored(depth, low, high)]
    height = max(1, round(_WIDTH * view.camera.height / view.camera.width))
    row = np.full((height + _CAPTION, len(panels) * (_WIDTH + _GAP) + _GAP, 3), BACKGROUND, np.uint8)
    for column, panel in enumerate(panels):
        x = _GAP + column * (_WIDTH + _GAP)
        row[:height, x : x + _WIDTH] = cv2.resize(panel, (_WIDTH, height), interpolation=cv2.INTER_AREA)
    found = measure_fidelity(gaussians, [view], rasterizer)
    facts = [f"frame {frame}"]
    if found.psnr_measured is not None:
        facts.append(f"{found.psnr_measured:.1f} dB where depth is measured")
    if found.depth_l1_m is not None:
        off = f"{100 * found.depth_l1_m:.1f} cm" if metric else f"{found.depth_l1_m:.3f} units"
        facts.append(f"depth off by {off}, shown from {low:.1f} to {high:.1f} {'m' if metric else 'units'}")
    write_text(row, ", ".join(facts), (_GAP, height + 20), SMALL)
    return row


def _colored(depth_m: NDArray[np.float32], low: float, high: float) -> NDArray[np.uint8]:
    """Returns (H, W, 3) colors: near is dark blue, far is red, no depth is black."""
    scaled = np.clip((depth_m - low) / max(high - low, 1e-6), 0, 1)
    picture = cv2.applyColorMap(np.rint(255 * scaled).astype(np.uint8), cv2.COLORMAP_TURBO)[:, :, ::-1].copy()
    picture[depth_m <= 0] = 0
    return picture
