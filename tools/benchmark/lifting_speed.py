"""Speed of the fusion of features, compared with a copy in memory."""

from __future__ import annotations

import time

from .figures import Figures, Line
from .machine_speed import copy_bytes_per_second

GAUSSIANS, DIMENSION = 100_000, 512
GRIDS = ((30, 40), (120, 160))
"""Cells of the features that are lifted: a ViT's patches, and features upsampled to a quarter of the image."""


def measure_lifting() -> Figures:
    """Bytes a second of the fusion of 512-dimensional features: for every Gaussian in view it reads the feature, and
    reads and writes the sum."""
    import numpy as np

    from freeocc3d.language.feature_fusion import FeatureFusion
    from freeocc3d.language.visibility import VisibleGaussians

    rng = np.random.default_rng(0)
    rows = np.arange(GAUSSIANS, dtype=np.int32)
    pixels = rng.permutation(480 * 640)[:GAUSSIANS].astype(np.int32)
    seen = VisibleGaussians(rows, pixels, np.ones(GAUSSIANS, np.float32), (480, 640))
    moved = GAUSSIANS * DIMENSION * (2 + 4 + 4)
    found: Figures = {"copy_bytes_per_second": copy_bytes_per_second()}
    for grid in GRIDS:
        features = rng.normal(size=(*grid, DIMENSION)).astype(np.float16)
        fusion = FeatureFusion(GAUSSIANS, DIMENSION, 0.6)
        times = []
        for _ in range(6):
            mark = time.perf_counter()
            fusion.add(seen, features)
            times.append(time.perf_counter() - mark)
        found["{} x {}".format(*grid)] = moved / min(times)
    return found


def lifting_lines(figures: Figures) -> list[Line]:
    """Rows of a table: what, measured, asked."""
    copy = figures["copy_bytes_per_second"]
    return [
        (
            f"512-d features lifted, {grid} cells",
            f"{1e-9 * figures[grid]:.1f} GB/s: {figures[grid] / copy:.2f} of a copy's {1e-9 * copy:.1f}",
            "1/3",
        )
        for grid in ("{} x {}".format(*grid) for grid in GRIDS)
    ]
