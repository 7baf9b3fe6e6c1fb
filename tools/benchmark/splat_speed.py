"""Speed of layer 4's projection, and the least time that its arithmetic and memory need."""

from __future__ import annotations

import time
from typing import Any

from .figures import Figures, Line
from .machine_speed import copy_bytes_per_second, exps_per_second
from .surface_gaussians import surface_gaussians
from .timing import lap, start_steps

SPLAT_GAUSSIANS, SPLAT_VOXEL_SIZE_M = 2_000_000, 0.08


def measure_splat() -> Figures:
    """Gaussians a second through layer 4's projection, and the time of its arithmetic and memory traffic alone."""
    import numpy as np

    from freeocc3d.core.voxel_keys import unpack_voxels
    from freeocc3d.occupancy import splat

    options, origin = splat.Options(voxel_size=SPLAT_VOXEL_SIZE_M), np.zeros(3)

    def project(gaussians: Any, seconds: dict[str, float]) -> Any:
        mark = time.perf_counter()
        bins = splat.bin_gaussians(gaussians, origin, options)
        mark = lap(seconds, "sort into blocks", mark)
        splat.compute_probability(bins, unpack_voxels(bins.packed))
        lap(seconds, "evaluate", mark)
        return bins

    project(surface_gaussians(1000), start_steps("sort into blocks", "evaluate"))  # compiles
    gaussians = surface_gaussians(SPLAT_GAUSSIANS)
    runs = []
    for _ in range(5):
        runs.append(start_steps("sort into blocks", "evaluate"))
        bins = project(gaussians, runs[-1])
    steps = sorted(runs, key=lambda run: sum(run.values()))[len(runs) // 2]  # the median run
    seconds = sum(steps.values())
    visits = int((bins.hi - bins.lo + 1).clip(min=0).astype(np.int64).prod(axis=1).sum())
    bytes_touched = sum(getattr(gaussians, name).nbytes for name in ("means", "scales", "quats_wxyz", "opacities"))
    bytes_touched += len(bins.packed) * 512 * 4
    copy_rate, exp_rate = copy_bytes_per_second(), exps_per_second()
    return {
        "gaussians": len(gaussians),
        "blocks": len(bins.packed),
        "seconds": seconds,
        "steps": steps,
        "gaussians_per_second": len(gaussians) / seconds,
        "voxel_visits": visits,
        "copy_bytes_per_second": copy_rate,
        "exps_per_second": exp_rate,
        "floor_seconds": {"memory": bytes_touched / copy_rate, "exp": visits / exp_rate},
    }


def splat_lines(figures: Figures) -> list[Line]:
    """Rows of a table: what, measured, asked."""
    floor = figures["floor_seconds"]
    steps = ", ".join(f"{step} {1e3 * value:.0f}" for step, value in figures["steps"].items())
    return [
        ("Gaussians to voxels", f"{figures['gaussians_per_second'] / 1e6:.2f} million/s", "at least 5"),
        ("  2 million at 8 cm", f"{1e3 * figures['seconds']:.0f} ms: {steps}", ""),
        (
            "  floor: their exponentials alone",
            f"{1e3 * floor['exp']:.1f} ms at {figures['exps_per_second'] / 1e9:.1f} billion/s",
            "",
        ),
        (
            "  floor: their memory alone",
            f"{1e3 * floor['memory']:.1f} ms at {figures['copy_bytes_per_second'] / 1e9:.1f} GB/s",
            "",
        ),
    ]
