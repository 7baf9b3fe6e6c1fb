"""Whether a map's lattice suits the building: the floor in one layer of voxels, walls one or two voxels thick.

The capture's ground truth says which voxels are floor and wall; the map is made with its own poses, and laid on the
truth by its trajectory. Only floor with nothing on it counts, and only walls with nothing beside them: what stands
there has voxels of its own.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .figures import Figures, tabulate
from .processes import COMMAND, PartFailed, run_timed

SIZES = 0.08, 0.04
_ABOVE_M = 0.3  # free above a floor with nothing on it
_NEAR_FLOOR_M = 0.2  # what the map has up to this height above and below such a floor is counted
_THIN = 3  # voxels: a wall of the truth is no thicker, and runs on along the other level axis
_LONG, _MARGIN = 6, 2  # voxels of that run, at least, and of its ends that do not count


def measure_layers(capture: str) -> Figures:
    """Layers of the floor and thickness of walls, of maps with voxels of each of SIZES. Raises PartFailed for a capture
    whose truth names neither floor nor walls."""
    from freeocc3d.evaluation.ground_truth import load_ground_truth

    truth = load_ground_truth(Path(capture) / "ground_truth.npz")
    names = [name.lower() for name in truth.classes]
    if not {"floor", "wall"} <= set(names):
        raise PartFailed(f"The ground truth of {capture} names no floor and no wall.")
    floor, wall = (truth.labels == names.index(name) for name in ("floor", "wall"))
    rows = {}
    with tempfile.TemporaryDirectory() as folder:
        for size in SIZES:
            path = str(Path(folder) / f"{size:g}")
            options = (f"--set=occupancy.voxel_size={size}", "--set=fitting.passes=0")
            run_timed([*COMMAND, "reconstruct", capture, "-o", path, *options])
            rows[f"{size:g}"] = measure_map(path, truth, floor, wall)
    return {"sizes": rows}


def measure_map(path: str, truth: Any, floor: NDArray[np.bool_], wall: NDArray[np.bool_]) -> Figures:
    """Figures of one map. floor, wall: (X, Y, Z) the truth's voxels of these classes."""
    from freeocc3d.core.types import OCCUPIED
    from freeocc3d.query.scan_map import load_map
    from freeocc3d.tracking.trajectory_alignment import align_trajectories, read_true_poses, select_estimated_poses

    made = load_map(path)
    alignment = align_trajectories(select_estimated_poses(made.trajectory), read_true_poses(made.capture))
    voxels = made.occupancy.voxels(OCCUPIED)
    centers = made.occupancy.centers(voxels)
    at = np.floor((alignment.to_true(centers) - truth.origin) / truth.voxel_size).astype(np.int64)
    inside = ((at >= 0) & (at < truth.labels.shape)).all(axis=1)
    voxels, centers, at = voxels[inside], centers[inside], at[inside]
    bare = find_bare_floor(truth.labels, floor, round(_ABOVE_M / truth.voxel_size))
    near = bare[at[:, 0], at[:, 1]] & (np.abs(centers[:, 2]) <= _NEAR_FLOOR_M)
    layers = np.bincount(voxels[near, 2] - voxels[:, 2].min()) if near.any() else np.zeros(1, np.int64)
    thickness = np.concatenate(
        [
            find_thickness(voxels, np.argmax(np.abs(alignment.rotation[axis])), widened(bare_wall, axis)[tuple(at.T)])
            for axis, bare_wall in enumerate(find_bare_walls(truth.labels, wall))
        ]
    )
    count = np.bincount(np.minimum(thickness, _THIN), minlength=_THIN + 1)
    upright = made.manifest.upright
    return {
        "up_by": upright.by if upright else "",
        "floor_voxels": int(layers.sum()),
        "floor_in_one_layer": float(layers.max() / max(layers.sum(), 1)),
        "walls": len(thickness),
        "walls_of_one": float(count[1] / max(len(thickness), 1)),
        "walls_of_two": float(count[2] / max(len(thickness), 1)),
        "walls_of_more": float(count[3] / max(len(thickness), 1)),
    }


def find_bare_floor(labels: NDArray[np.uint8], floor: NDArray[np.bool_], above: int) -> NDArray[np.bool_]:
    """(X, Y) columns of floor with nothing on it, as their four neighbors are: ``above`` free voxels follow it."""
    top = floor.shape[2] - 1 - np.argmax(floor[:, :, ::-1], axis=2)
    free = np.pad(labels == 0, ((0, 0), (0, 0), (0, above)))
    over = [np.take_along_axis(free, (top + n)[:, :, None], axis=2)[:, :, 0] for n in range(1, above + 1)]
    bare = np.pad(floor.any(axis=2) & np.all(over, axis=0), 1)
    return np.asarray(bare[1:-1, 1:-1] & bare[2:, 1:-1] & bare[:-2, 1:-1] & bare[1:-1, 2:] & bare[1:-1, :-2])


def find_bare_walls(labels: NDArray[np.uint8], wall: NDArray[np.bool_]) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """(X, Y, Z) voxels of walls across x, and of walls across y, with nothing beside them, nor beside the next voxels
    of the wall: a map may lie a voxel aside. Lamps, pictures and curtains are beside a wall."""
    occupied = (labels > 0) & (labels < 255)
    lengths = [measure_runs(occupied, axis) for axis in (0, 1)]
    others = [_neighbors(occupied & ~wall, axis, _THIN).any(axis=0) for axis in (0, 1)]
    x, y = (wall & ~others[a] & (lengths[a] <= _THIN) & (measure_runs(wall, 1 - a) >= _LONG) for a in (0, 1))
    x, y = (np.asarray(_neighbors(walls, 2, 1).all(axis=0)) for walls in (x, y))  # neither floor nor ceiling
    return np.asarray(_neighbors(x, 1, _MARGIN).all(axis=0)), np.asarray(_neighbors(y, 0, _MARGIN).all(axis=0))


def widened(walls: NDArray[np.bool_], axis: int) -> NDArray[np.bool_]:
    """(X, Y, Z) the voxels and their neighbors along an axis."""
    return np.asarray(_neighbors(walls, axis, 1).any(axis=0))


def _neighbors(voxels: NDArray[np.bool_], axis: int, reach: int) -> NDArray[np.bool_]:
    """(2 reach + 1, X, Y, Z) the voxels moved along an axis by up to ``reach``."""
    padded = np.pad(voxels, [(reach, reach) if n == axis else (0, 0) for n in range(3)])
    starts = range(2 * reach + 1)
    return np.stack([np.take(padded, range(start, start + voxels.shape[axis]), axis) for start in starts])


def measure_runs(occupied: NDArray[np.bool_], axis: int) -> NDArray[np.int64]:
    """(X, Y, Z) the number of occupied voxels in a row along an axis, of which each occupied voxel is one; else 0."""
    line = np.moveaxis(occupied, axis, 2)
    starts = line & ~np.pad(line, ((0, 0), (0, 0), (1, 0)))[:, :, :-1]
    run = np.cumsum(starts.ravel()).reshape(line.shape)
    length = np.bincount(run[line], minlength=int(run.max()) + 1)
    return np.moveaxis(np.where(line, length[run], 0), 2, axis)


def find_thickness(voxels: NDArray[np.int32], axis: Any, chosen: NDArray[np.bool_]) -> NDArray[np.int64]:
    """The lengths of the rows of (V, 3) occupied voxels along a level axis that hold a chosen one."""
    low = voxels.min(axis=0)
    dense = np.zeros(voxels.max(axis=0) - low + 1, bool)
    dense[tuple((voxels - low).T)] = True
    wanted = np.zeros_like(dense)
    wanted[tuple((voxels[chosen] - low).T)] = True
    lengths = np.moveaxis(measure_runs(dense, int(axis)), int(axis), 2)
    line = np.moveaxis(dense, int(axis), 2)
    starts = line & ~np.pad(line, ((0, 0), (0, 0), (1, 0)))[:, :, :-1]
    run = np.cumsum(starts.ravel()).reshape(line.shape)
    held = np.unique(run[np.moveaxis(wanted, int(axis), 2)])
    return np.asarray(lengths[starts][held - 1])


def tabulate_layers(rows: Sequence[Figures]) -> list[str]:
    """A table of all captures and sizes of voxels."""
    header = (
        "capture", "voxels, m", "up by", "floor in one layer (asked >= 98 %)", "walls of one voxel", "of two",
        "of more (asked 0)",
    )  # fmt: skip
    table = [
        (
            row["capture"],
            size,
            figures["up_by"],
            *(f"{figures[key]:.1%}" for key in ("floor_in_one_layer", "walls_of_one", "walls_of_two", "walls_of_more")),
        )
        for row in rows
        for size, figures in row["sizes"].items()
    ]
    return tabulate(header, table)
