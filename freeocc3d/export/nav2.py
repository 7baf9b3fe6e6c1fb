"""ROS map_server and Nav2: `map.yaml` and `map.pgm`, a plan of the obstacles between two heights above the floor.

A pixel is occupied (0) if any voxel of its column between the heights is occupied; else free (254) if enough of them
are free; else unknown (205). The floor lies below the lower height and is no obstacle. The top row has the largest y,
and `origin` is the lower left corner of the lower left pixel, as map_server expects. NAME.yaml.json holds the frame.
`avoid` adds masks for Nav2's KeepoutFilter with the same cells: NAME.WORD.yaml and .pgm with the costs of each word,
and NAME.avoid.yaml with the costs of all words. Source: nav2_map_server's map_io.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from ..core.errors import ConfigError, ExportError
from ..core.types import FREE, OCCUPIED, UNKNOWN, Occupancy
from ..query.scan_map import Map
from ..settings.option_types import Share
from .export_frames import BoxOptions, PlacedVoxels, UprightFrame, find_floor_z, place_voxels, write_description
from .keepout_masks import parse_avoided, write_layers
from .map_server_files import PLAN, CellGrid, write_map

REQUIRES: tuple[str, ...] = ()
ENDINGS = (".yaml", ".yml")

_PIXEL = {OCCUPIED: 0, FREE: 254, UNKNOWN: 205}
_MOST_PIXELS = 1 << 28


class PlanOptions(BoxOptions, frozen=True):
    """The heights of obstacles, and what counts as free."""

    frame: UprightFrame = "gravity"
    """"gravity" (walls along x and y) or "start" (z up, first camera at the origin, its view along x)."""
    min_height: Annotated[float, Meta(ge=-1000, le=1000)] = 0.1
    """Least height of an obstacle above the floor, meters. The robot drives over lower things."""
    max_height: Annotated[float, Meta(gt=0, le=1000)] = 1.8
    """Greatest height of an obstacle above the floor, meters. The robot drives under higher things."""
    min_free: Share = 0.5
    """Least share of a column's voxels between the heights that must be free for a free cell, 0…1; 0 = any."""
    inflation: Annotated[float, Meta(ge=0, le=1000)] = 0.0
    """Radius around obstacles that is occupied too, meters; most planners inflate obstacles themselves."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.min_height >= self.max_height:
            raise ConfigError(f"'min_height' must be below 'max_height', got {self.min_height} and {self.max_height}.")


class Options(PlanOptions, frozen=True):
    """The plan, and what the robot has to avoid."""

    avoid: tuple[str, ...] = ()
    """Words with a cost for the robot, as in [carpet:40%, glass:0.5]. WORD: the robot must not enter. WORD:METERS: it
    must keep this distance. WORD:COST%: it may enter at a cost of 1 to 99. WORD:METERS:COST%: the cost falls to 0 over
    the distance. Things above max_height do not count."""

    def __post_init__(self) -> None:
        super().__post_init__()
        parse_avoided(self.avoid)


@dataclass(frozen=True)
class Plan:
    """Obstacles seen from above. cells: (X, Y) FREE, OCCUPIED or UNKNOWN.  floor_z: height of the floor in the frame.
    there: the voxels that it was made of."""

    cells: NDArray[np.uint8]
    grid: CellGrid
    floor_z: float
    there: PlacedVoxels


def write(scan_map: Map, path: Path, options: Options) -> list[str]:
    """Writes the plan. Returns a sentence for each word to avoid that is nowhere. Raises
    ExportError if nothing is known between the heights, or if the map does not understand a word."""
    made = make_plan(scan_map, options)
    there, grid, floor = made.there, made.grid, made.floor_z
    pixels = np.zeros(256, np.uint8)
    pixels[list(_PIXEL)] = list(_PIXEL.values())
    about = f"obstacles {options.min_height:g} to {options.max_height:g} m above the floor"
    write_map(path, pixels[made.cells], grid, PLAN, about)
    layers, notes = write_layers(scan_map, path, there, parse_avoided(options.avoid), grid, floor + options.max_height)
    described = {"floor_z_m": floor, "min_height_m": options.min_height, "max_height_m": options.max_height}
    write_description(path, {**there.described(), **described, **({"avoid": layers} if layers else {})})
    return notes


def make_plan(scan_map: Map, options: PlanOptions) -> Plan:
    """Returns the plan that the options ask for. Raises ExportError if nothing is known between the heights."""
    there = place_voxels(scan_map, options.frame, box=options.box)
    floor, size = find_floor_z(scan_map, there.T_frame_map), there.occupancy.voxel_size
    cells, origin = plan(there.occupancy, floor + options.min_height, floor + options.max_height, options.min_free)
    if options.inflation > 0:
        cells = inflate(cells, options.inflation / size)
    return Plan(cells, CellGrid(origin, size, (cells.shape[0], cells.shape[1]), there.frame), floor, there)


def plan(
    occupancy: Occupancy, low: float, high: float, min_free: float
) -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
    """Returns the (X, Y) plan, FREE, OCCUPIED or UNKNOWN, over the box of the known voxels, and the (2,) lower corner
    of cell (0, 0), meters. Each column counts voxels with centers between two heights z; voxels must be of one size.
    Raises ExportError."""
    size, (x0, y0, z0) = occupancy.voxel_size, occupancy.origin
    first, last = int(np.ceil((low - z0) / size - 0.5)), int(np.floor((high - z0) / size - 0.5))
    columns = {}
    for state in (OCCUPIED, FREE):
        voxels = occupancy.voxels(state)
        columns[state] = voxels[(voxels[:, 2] >= first) & (voxels[:, 2] <= last), :2]
    every = np.concatenate(list(columns.values()))
    if not len(every):
        raise ExportError(f"Nothing is known between the heights {low:g} and {high:g} m, so there is no plan to write.")
    corner = every.min(axis=0)
    shape = every.max(axis=0).astype(np.int64) - corner + 1
    if shape.prod() > _MOST_PIXELS:
        raise ExportError(
            f"A plan of {shape[0]} x {shape[1]} cells is too large: reconstruct the map with larger voxels."
        )
    counts = {
        state: np.bincount((at - corner) @ np.array((shape[1], 1)), minlength=int(shape.prod())).reshape(shape)
        for state, at in columns.items()
    }
    cells = np.full(shape, UNKNOWN, np.uint8)
    cells[counts[FREE] >= max(1.0, min_free * (last - first + 1))] = FREE
    cells[counts[OCCUPIED] > 0] = OCCUPIED
    return cells, np.array((x0, y0)) + corner * size


def inflate(cells: NDArray[np.uint8], radius: float) -> NDArray[np.uint8]:
    """Returns the plan with all cells within ``radius`` cells of an occupied cell occupied."""
    from scipy import ndimage

    if not (cells == OCCUPIED).any():
        return cells
    near = ndimage.distance_transform_edt(cells != OCCUPIED) <= radius
    return np.where(near, OCCUPIED, cells).astype(np.uint8)
