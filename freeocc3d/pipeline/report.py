"""The content of report.json: timings, memory, status of the frames, warnings, submaps."""

from __future__ import annotations

import resource
from typing import Any

import numpy as np

from ..core.types import Submap, Trajectory
from ..storage.work_folder import WorkFolder
from .mapper import Mapper


def report_of(
    work: WorkFolder, mapper: Mapper, trajectory: Trajectory, submaps: list[Submap], tracking_reason: str
) -> dict[str, Any]:
    """The report of a run. tracking_reason: why its tracker was chosen; empty if the configuration names it."""
    status, count = np.unique(trajectory.status, return_counts=True)
    peak_kib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return {
        "seconds": {name: round(value, 3) for name, value in work.seconds.items()},
        "peak_memory_bytes": peak_kib * 1024,
        "frames": {str(s): int(n) for s, n in zip(status, count, strict=True)},
        "broken": {str(index): text for index, text in work.broken.items()},
        "warnings": [notice.to_dict() for notice in work.warnings],
        "upright": None if mapper.upright is None else mapper.upright.evidence(),
        "color_focal": getattr(mapper.capture, "color_focal", 1.0),
        "tracking": {"backend": mapper.settings.tracking.backend, "reason": tracking_reason},
        "submaps": [
            {
                "frames": len(submap.frames),
                "first": int(submap.frames[0]),
                "last": int(submap.frames[-1]),
                "keyframes": len(submap.keyframes),
                "mapped": number == 0,
                "closures": [
                    [*ends, held] for ends, held in zip(submap.closures.tolist(), submap.held.tolist(), strict=True)
                ],
            }
            for number, submap in enumerate(submaps)
        ],
        "bytes_per_gaussian": 67,
        "frame_log": {
            "timestamp": trajectory.timestamps.tolist(),
            "status": trajectory.status.tolist(),
            "confidence": np.round(trajectory.confidence.astype(np.float64), 3).tolist(),
        },
    }
