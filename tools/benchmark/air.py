"""What moving people, panes and mixed edges leave in the air of a map, and what is lost by taking it away.

The disturbances are put into the depth of a capture, which is mapped at its own poses. A voxel is in the air if neither
it nor a neighbor is occupied in the map of the undisturbed depth, and lost if it is the other way around. It is opened
if only the map of the disturbed depth calls it free.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from freeocc3d.core.types import PosedFrame

from .disturbed_depth import (
    Change,
    disturb,
    make_panes,
    mix_edges,
    read_posed,
    stand_and_leave,
    walk_ahead,
)
from .figures import Figures, tabulate

_MOST_FRAMES, _GROUP = 200, 10
"""Frames, evenly spread, that are mapped; and those that count as one keyframe with its followers."""

_NEAR_PANES_M = 0.75  # voxels that are not counted as lost: what a pane replaces


def measure_air(capture: str) -> Figures:
    """Voxels in the air of maps of disturbed depth, by disturbance, without and with the evidence of all frames."""
    from freeocc3d.capture import open_capture

    opened = open_capture(capture)
    posed = [index for index in range(len(opened)) if opened.pose(index) is not None]
    frames = posed[:: -(-len(posed) // _MOST_FRAMES)]
    poses = np.array([opened.pose(index) for index in frames])
    looks = list(read_posed(opened, frames, _GROUP))
    panes, middles = make_panes(looks)
    changes: dict[str, Change] = {
        "somebody who walks": walk_ahead(poses),
        "somebody who stands, and leaves": stand_and_leave(poses),
        "panes": panes,
        "mixed edges": mix_edges,
    }
    clean, clean_free = _map(looks, None, True)
    figures: dict[str, Any] = {"frames": len(frames), "occupied": len(clean), "disturbances": {}}
    kept = np.ones(len(clean), bool)
    for name, change in changes.items():
        if change is panes:
            off = _centers(clean)[:, None] - middles
            kept = (np.linalg.norm(off, axis=2) > _NEAR_PANES_M).all(axis=1)
        (every, _), (found, found_free) = (_map(looks, change, evidence) for evidence in (False, True))
        figures["disturbances"][name] = {
            "brought": int((~_beside(every, clean)).sum()),
            "left": int((~_beside(found, clean)).sum()),
            "lost": float((~_beside(clean, found) & kept).mean()),
            "opened": _count_others(found_free, clean_free),
        }
        kept[:] = True
    return figures


def _map(
    looks: Sequence[PosedFrame], change: Change | None, evidence: bool
) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """(V, 3) occupied and (F, 3) free voxels of the map of the frames with a change, at the usual options; without the
    evidence of all frames, all depth makes surface and carves."""
    from freeocc3d.core.types import FREE, OCCUPIED
    from freeocc3d.gaussians import anchors
    from freeocc3d.occupancy import build
    from freeocc3d.occupancy.confirmed_depth import hide_unconfirmed
    from freeocc3d.settings import config

    changed = list(disturb(looks, change))
    first = np.unique([look.keyframe for look in looks], return_index=True)[1]
    poses = np.stack([looks[n].T_world_cam for n in first])
    settings = config.resolve({"gaussians": {"denoise": evidence}})
    cells = anchors.AnchoredCells(settings.gaussians, 0.5 * settings.occupancy.voxel_size, poses)
    for look in changed:
        cells.add(look)
    gaussians = cells.gaussians(changed)
    nothing = np.zeros((len(gaussians), 0), np.float16)
    seen = hide_unconfirmed(changed, gaussians, settings.occupancy.voxel_size) if evidence else changed
    made = build.build_occupancy(gaussians, nothing, seen, settings.occupancy, settings.carving)
    return made.voxels(OCCUPIED), made.voxels(FREE)


def _count_others(voxels: NDArray[np.int32], known: NDArray[np.int32]) -> int:
    """Voxels (V, 3) that are none of the known ones (K, 3)."""
    from freeocc3d.core.voxel_keys import contains, pack_voxels

    return int((~contains(np.sort(pack_voxels(known)), pack_voxels(voxels))).sum())


def _centers(voxels: NDArray[np.int32]) -> NDArray[np.floating]:
    from freeocc3d.settings.stages import OccupancyOptions

    return (voxels + 0.5) * OccupancyOptions().voxel_size


def _beside(voxels: NDArray[np.int32], others: NDArray[np.int32]) -> NDArray[np.bool_]:
    """(V,) whether each voxel or one of its 26 neighbors is one of the others."""
    from freeocc3d.core.voxel_keys import pack_voxels

    known = np.sort(pack_voxels(others))
    found = np.zeros(len(voxels), bool)
    for step in np.stack(np.meshgrid(*[(-1, 0, 1)] * 3), axis=-1).reshape(-1, 3):
        found |= np.isin(pack_voxels(voxels + step), known)
    return found


def tabulate_air(rows: Sequence[Figures]) -> list[str]:
    """A table of all captures."""
    return tabulate(
        (
            "capture",
            "put into the depth",
            "voxels in the air without evidence",
            "with it",
            "surface lost",
            "opened",
        ),
        [
            (
                row["capture"],
                name,
                str(found["brought"]),
                str(found["left"]),
                f"{found['lost']:.1%}",
                str(found["opened"]),
            )
            for row in rows
            if "disturbances" in row
            for name, found in row["disturbances"].items()
        ],
    )
