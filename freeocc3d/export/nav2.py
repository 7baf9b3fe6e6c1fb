"""ROS map_server and Nav2: `map.yaml` and `map.pgm`, a plan of what stands between two heights above the floor.

A pixel is occupied (0) where any voxel of its column between the heights is; else free (254) where enough of them are
free; else unknown (205). The floor lies below the lower height and is no obstacle. The top row is the largest y,
`origin` the lower left corner of the lower left pixel, as map_server reads them. NAME.yaml.json holds the frame.
`avoid` adds a layer of costs a word, NAME.WORD.yaml and .pgm of the same cells, and NAME.avoid.yaml of all words: masks
for Nav2's KeepoutFilter. Source: nav2_map_server's map_io.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..core.errors import ConfigError, ExportError
from ..core.types import FREE, OCCUPIED, UNKNOWN, Occupancy
from ..query.scan_map import Map
from ..settings.option_types import Finite, NotNegative, Positive, Share
from .export_frames import BoxOptions, UprightFrame, find_floor_z, place_voxels, write_description
from .keepout_masks import parse_avoided, write_layers
from .map_server_files import PLAN, CellGrid, write_map

REQUIRES: tuple[str, ...] = ()

_PIXEL = {OCCUPIED: 0, FREE: 254, UNKNOWN: 205}
_MOST_PIXELS = 1 << 28


class Options(BoxOptions, frozen=True):
    """The robot's heights, and what counts as free."""

    frame: UprightFrame = "gravity"
    """"gravity" (walls along x and y) or "first-camera" (origin there, x where it looked)."""
    min_height: Finite = 0.1
    """Meters above the floor from which something is an obstacle; what is lower is driven over."""
    max_height: Positive = 1.8
    """Meters above the floor up to which something is an obstacle; what is higher is driven under."""
    min_free: Share = 0.5
    """Share of a column's voxels between the heights that have to be free for its cell to be free, 0…1; 0 = any."""
    inflation: NotNegative = 0.0
    """Meters around obstacles that are occupied as well; planners mostly inflate by themselves."""
    avoid: tuple[str, ...] = ()
    """Words whose places cost a robot, as in [carpet:40%, glass:0.5]: WORD is not to be entered, WORD:METERS to be kept
    this far from, WORD:COST% may be entered at a cost of 1 to 99, and WORD:METERS:COST% near by at a cost that falls to
    0 over the meters. What hangs above max_height does not count."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.min_height >= self.max_height:
            raise ConfigError(f"'min_height' must be below 'max_height', got {self.min_height} and {self.max_height}.")
        parse_avoided(self.avoid)


def write(scan_map: Map, path: Path, options: Options) -> list[str]:
    """Write the plan; returns a sentence for each word to avoid that is nowhere. Raises ConfigError unless the file is
    named .yaml, ExportError if nothing is known between the heights, or of a word."""
    if path.suffix not in (".yaml", ".yml"):
        raise ConfigError(f"A map_server map is named by its .yaml, got '{path.name}'.")
    there = place_voxels(scan_map, options.frame, box=options.box)
    floor, size = find_floor_z(scan_map, there.T_frame_map), there.occupancy.voxel_size
    cells, origin = plan(there.occupancy, floor + options.min_height, floor + options.max_height, options.min_free)
    if options.inflation > 0:
        cells = inflate(cells, options.inflation / size)
    grid = CellGrid(origin, size, (cells.shape[0], cells.shape[1]), there.frame)
    pixels = np.zeros(256, np.uint8)
    pixels[list(_PIXEL)] = list(_PIXEL.values())
    about = f"obstacles {options.min_height:g} to {options.max_height:g} m above the floor"
    write_map(path, pixels[cells], grid, PLAN, about)
    layers, notes = write_layers(scan_map, path, there, parse_avoided(options.avoid), grid, floor + options.max_height)
    described = {"floor_z_m": floor, "min_height_m": options.min_height, "max_height_m": options.max_height}
    write_description(path, {**there.described(), **described, **({"avoid": layers} if layers else {})})
    return notes


def plan(
    occupancy: Occupancy, low: float, high: float, min_free: float
) -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
    """(X, Y) FREE, OCCUPIED or UNKNOWN of the columns over the known voxels' box, from the voxels of one size whose
    centers lie between two heights z, and the (2,) lower corner of cell (0, 0), meters. Raises ExportError."""
    size, (x0, y0, z0) = occupancy.voxel_size, occupancy.origin
    first, last = int(np.ceil((low - z0) / size - 0.5)), int(np.floor((high - z0) / size - 0.5))
    columns = {}
    for state in (OCCUPIED, FREE):
        voxels = occupancy.voxels(state)
        columns[state] = voxels[(voxels[:, 2] >= first) & (voxels[:, 2] <= last), :2]
    every = np.concatenate(list(columns.values()))
    if not len(every):
        raise ExportError(f"Nothing is known between the heights {low:g} and {high:g} m: there is no plan to write.")
    corner = every.min(axis=0)
    shape = every.max(axis=0).astype(np.int64) - corner + 1
    if shape.prod() > _MOST_PIXELS:
        raise ExportError(f"A plan of {shape[0]} x {shape[1]} cells is too large: map with larger voxels.")
    counts = {
        state: np.bincount((at - corner) @ np.array((shape[1], 1)), minlength=int(shape.prod())).reshape(shape)
        for state, at in columns.items()
    }
    cells = np.full(shape, UNKNOWN, np.uint8)
    cells[counts[FREE] >= max(1.0, min_free * (last - first + 1))] = FREE
    cells[counts[OCCUPIED] > 0] = OCCUPIED
    return cells, np.array((x0, y0)) + corner * size


def inflate(cells: NDArray[np.uint8], radius: float) -> NDArray[np.uint8]:
    """The plan with every cell within ``radius`` cells of an occupied one occupied."""
    from scipy import ndimage

    if not (cells == OCCUPIED).any():
        return cells
    near = ndimage.distance_transform_edt(cells != OCCUPIED) <= radius
    return np.where(near, OCCUPIED, cells).astype(np.uint8)
