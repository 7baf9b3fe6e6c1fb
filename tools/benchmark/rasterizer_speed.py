"""Speed of the rasterizers: forward and backward of 300,000 Gaussians at 320 x 240, compiled against plain PyTorch; on
a GPU also gsplat against plain PyTorch."""

from __future__ import annotations

import statistics
import time
from typing import Any

from .figures import Figures, Line

GAUSSIANS, WIDTH, HEIGHT = 300_000, 320, 240
_LAYERS = 3


def surfaces_in_view(count: int, width: int, height: int) -> tuple[list[Any], Any, Any]:
    """Gaussians on three wavy surfaces, one behind the other, all within the image: the hardest case that a map makes.
    Returns their five arrays, T_cam_world, and the camera."""
    import numpy as np
    import torch

    from freeocc3d.core.types import Intrinsics

    rng = np.random.default_rng(0)
    f = 0.85 * width
    camera = Intrinsics(width, height, f, f, width / 2 - 0.5, height / 2 - 0.5)
    u, v, layer = rng.uniform(0, width, count), rng.uniform(0, height, count), rng.integers(0, _LAYERS, count)
    z = 1.5 + 1.2 * layer + 0.4 * np.sin(u / 40 + layer) + 0.3 * np.cos(v / 30)
    spacing = z / f * np.sqrt(width * height * _LAYERS / count)
    arrays = (
        np.stack(((u - camera.cx) / f * z, (v - camera.cy) / f * z, z), axis=1),
        0.7 * spacing[:, None] * np.exp(rng.normal(0, 0.3, (count, 3))),
        rng.normal(size=(count, 4)),
        np.clip(rng.normal(0.7, 0.15, count), 0.05, 0.99),
        rng.uniform(size=(count, 3)),
    )
    return [torch.tensor(array, dtype=torch.float32) for array in arrays], torch.eye(4), camera


def measure_rasterizer() -> Figures:
    """Seconds of each, and how much they differ."""
    import torch

    from freeocc3d.gaussians.rasterizers import cpu, reference

    scene = surfaces_in_view(GAUSSIANS, WIDTH, HEIGHT)
    compiled = cpu.load()
    _step(compiled, *surfaces_in_view(1000, 64, 48))  # compiles
    expected, slow = _timed(reference.ReferenceRasterizer(), scene, 1)
    found, fast = _timed(compiled, scene, 7)
    figures: Figures = {
        "gaussians": GAUSSIANS,
        "reference_seconds": slow,
        "cpu_seconds": fast,
        "times_faster": slow / fast,
        "largest_difference": float((found - expected).abs().max() / expected.abs().max()),
    }
    if torch.cuda.is_available():
        figures["cuda"] = _on_cuda(scene)
    return figures


def _on_cuda(scene: tuple[list[Any], Any, Any]) -> Figures:
    from freeocc3d.gaussians.rasterizers import gsplat, reference

    arrays, T, camera = scene
    there = [array.cuda() for array in arrays], T.cuda(), camera
    expected, slow = _timed(reference.ReferenceRasterizer("cuda:0"), there, 2)
    found, fast = _timed(gsplat.load(gsplat.Options()), there, 50)
    return {
        "reference_seconds": slow,
        "gsplat_seconds": fast,
        "frames_per_second": 1 / fast,
        "mean_difference": float((found - expected).abs().mean()),
        "largest_difference": float((found - expected).abs().max() / expected.abs().max()),
    }


def _timed(rasterizer: Any, scene: tuple[list[Any], Any, Any], repeats: int) -> tuple[Any, float]:
    """The image, and the median seconds of forward and backward."""
    seconds = []
    for _ in range(repeats + 1):
        mark = time.perf_counter()
        image = _step(rasterizer, *scene)
        seconds.append(time.perf_counter() - mark)
    return image, statistics.median(seconds[1:])


def _step(rasterizer: Any, arrays: list[Any], T_cam_world: Any, camera: Any) -> Any:
    import torch

    from freeocc3d.gaussians.rasterizers.base import Splats

    leaves = [array.clone().requires_grad_() for array in arrays]
    image, depth, alpha = rasterizer.render(Splats(*leaves), T_cam_world, camera)
    (image.sum() + depth.sum() + alpha.sum()).backward()
    if image.is_cuda:
        torch.cuda.synchronize()
    return torch.cat((image, depth[..., None], alpha[..., None]), dim=2).detach()


def rasterizer_lines(figures: Figures) -> list[Line]:
    """Rows of the report: what, measured, asked."""
    count = f"{figures['gaussians']:,} Gaussians at {WIDTH} x {HEIGHT}, forward and backward"
    lines = [
        (f"`cpu`: {count}", f"{figures['cpu_seconds']:.3f} s", "0.3 s"),
        (f"`reference`: {count}", f"{figures['reference_seconds']:.1f} s", ""),
        ("times faster", f"{figures['times_faster']:.0f}", "20"),
        ("largest difference of their images", f"{figures['largest_difference']:.1e}", "1e-4"),
    ]
    if cuda := figures.get("cuda"):
        lines += [
            ("`gsplat`", f"{cuda['frames_per_second']:.0f} frames a second", ""),
            ("`reference` on CUDA", f"{cuda['reference_seconds']:.2f} s", ""),
            (
                "mean and largest difference of their images",
                f"{cuda['mean_difference']:.1e}, {cuda['largest_difference']:.1e}",
                "",
            ),
        ]
    return lines
