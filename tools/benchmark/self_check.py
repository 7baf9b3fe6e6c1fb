"""What ``freeocc3d check`` says of a map: at its own poses, at the capture's poses, and at poses that drift."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from .figures import Figures, Line

DRIFTS_M = (0.01, 0.02, 0.04, 0.08)
"""How far the last keyframe is moved; those before it, in proportion to their place in the path."""

_WAY = np.array((0.7, 0.1, 0.7))


def measure_check(map_path: str) -> Figures:
    """The measures of a map, the agreement of its keyframes at other poses, and the share of the run's time that its
    own check took."""
    from freeocc3d.pipeline.map_check import check_map
    from freeocc3d.query.scan_map import load_map
    from freeocc3d.tracking.view_agreement import measure_agreement

    made = load_map(map_path)
    found = check_map(made)
    own = made.trajectory.T_world_keyframe
    start = time.process_time()
    measure_agreement(found.views, own)
    seconds = time.process_time() - start
    others = {"given": _given(made), **{f"drift {100 * drift:g} cm": _drifting(own, drift) for drift in DRIFTS_M}}
    return {
        "measures": {
            measure.name: {"value": measure.value, "compared": measure.compared, "verdict": measure.verdict}
            for measure in found.measures
        },
        "agreement": {
            "own": _agreement(found.agreement),
            **{name: _agreement(measure_agreement(found.views, T)) for name, T in others.items() if T is not None},
        },
        "comparing_s": seconds,
        "share_of_run": made.report["seconds"]["check"] / sum(made.report["seconds"].values()),
    }


def _given(made: Any) -> Any:
    """(K, 4, 4) the capture's own poses of the keyframes; None if one has none."""
    from freeocc3d.tracking.trajectory_alignment import read_true_poses

    poses = read_true_poses(made.capture)
    by_time = dict(zip(poses.timestamps.tolist(), poses.T_world_cam, strict=True))
    times = made.trajectory.timestamps[made.trajectory.keyframes].tolist()
    return np.stack([by_time[t] for t in times]) if set(times) <= set(by_time) else None


def _drifting(T: Any, drift_m: float) -> Any:
    moved = T.copy()
    moved[:, :3, 3] += np.linspace(0, drift_m, len(T))[:, None] * _WAY
    return moved


def _agreement(found: Any) -> dict[str, float | None]:
    told: dict[str, float | None] = {}
    for name, pairs in (("step", found.steps), ("revisit", found.revisits)):
        for key in ("off_m", "sigmas", "gray"):
            told[f"{name}_{key}"] = float(np.median([getattr(pair, key) for pair in pairs])) if pairs else None
        told[f"{name}_pairs"] = len(pairs)
    return told


def check_lines(figures: Figures) -> list[Line]:
    """Rows of a table: what, measured, asked."""
    lines: list[Line] = []
    for name, told in figures["agreement"].items():
        if told["revisit_off_m"] is None or told["step_off_m"] is None:
            continue
        said = f"{100 * told['step_off_m']:.2f}, {100 * told['revisit_off_m']:.2f} cm, "
        said += f"{told['revisit_sigmas'] / told['step_sigmas']:.2f} steps"
        lines.append((f"check: depth from step to step, at revisits, {name} poses", said, ""))
    for name, measure in figures["measures"].items():
        if measure["value"] is not None:
            lines.append((f"  {name}: {measure['verdict']}", f"{measure['value']:.4g}", ""))
    lines.append(("  share of the run's time that it adds to saving", f"{100 * figures['share_of_run']:.1f} %", "2 %"))
    return lines
