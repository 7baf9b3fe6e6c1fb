"""ROS map_server and Nav2: `map.yaml` and `map.pgm`, a plan of what stands between two heights above the floor.

A pixel is occupied (0) where any voxel of its column between the heights is; else free (254) where enough of them are
free; else unknown (205). The floor lies below the lower height and is no obstacle. The top row is the largest y,
`origin` the lower left corner of the lower left pixel, as map_server reads them. NAME.yaml.json holds the frame.
`avoid` adds a layer a word, NAME.WORD.yaml and .pgm of the same size: occupied where a robot is to keep out, free
elsewhere, a mask for Nav2's keepout filter. Source: nav2_map_server's map_io.
"""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import ConfigError, ExportError
from ..registry import require_positive
from ..store import Map
from ..types import FREE, OCCUPIED, UNKNOWN, Occupancy
from .frames import Placed, check_upright, floor_z, placed, write_description

REQUIRES: tuple[str, ...] = ()

_PIXEL = {OCCUPIED: 0, FREE: 254, UNKNOWN: 205}
_THRESHOLDS = 0.65, 0.196  # an unknown pixel is 1 - 205 / 255 = 0.19608, which 0.196 does not take for free
_MOST_PIXELS = 1 << 28


@dataclass(frozen=True)
class Options:
    """The robot's heights, and what counts as free."""

    frame: str = "gravity"
    """"gravity" (walls along x and y) or "first-camera" (origin there, x where it looked)."""
    min_height: float = 0.1
    """Metres above the floor from which something is an obstacle; what is lower is driven over."""
    max_height: float = 1.8
    """Metres above the floor up to which something is an obstacle; what is higher is driven under."""
    min_free: float = 0.5
    """Share of a column's voxels between the heights that have to be free for its cell to be free, 0…1; 0 = any."""
    inflation: float = 0.0
    """Metres around obstacles that are occupied as well; planners mostly inflate by themselves."""
    avoid: tuple[str, ...] = ()
    """Words whose places a robot is to keep out of, each with the metres to keep from them, 0 if not given, as in
    [carpet, glass:0.5]."""

    def __post_init__(self) -> None:
        check_upright(self.frame)
        require_positive(self, "max_height")
        if self.min_height >= self.max_height:
            raise ConfigError(f"'min_height' must be below 'max_height', got {self.min_height} and {self.max_height}.")
        if not 0 <= self.min_free <= 1:
            raise ConfigError(f"'min_free' must be 0 to 1, got {self.min_free}.")
        if self.inflation < 0:
            raise ConfigError(f"'inflation' must not be negative, got {self.inflation}.")
        _avoided(self.avoid)


def write(scan_map: Map, path: Path, options: Options) -> None:
    """Write the plan. Raises ConfigError unless the file is named .yaml, ExportError if nothing is known between the
    heights."""
    if path.suffix not in (".yaml", ".yml"):
        raise ConfigError(f"A map_server map is named by its .yaml, got '{path.name}'.")
    there = placed(scan_map, options.frame)
    floor = floor_z(scan_map, there.T_frame_map)
    cells, origin = plan(there.occupancy, floor + options.min_height, floor + options.max_height, options.min_free)
    if options.inflation > 0:
        cells = inflated(cells, options.inflation / there.occupancy.voxel_size)
    heights = f"obstacles {options.min_height:g} to {options.max_height:g} m above the floor"
    _write_map(path, cells, origin, there.occupancy.voxel_size, f"{there.frame} frame; {heights}")
    described = {"floor_z_m": floor, "min_height_m": options.min_height, "max_height_m": options.max_height}
    layers = _write_layers(scan_map, path, there, _avoided(options.avoid), cells.shape, origin)
    write_description(path, {**there.described(), **described, **({"avoid": layers} if layers else {})})


def _write_map(path: Path, cells: NDArray[np.uint8], origin: NDArray[np.float64], size: float, about: str) -> None:
    image = path.with_suffix(".pgm")
    write_pgm(image, cells)
    occupied, free = _THRESHOLDS
    lines = [
        f"# freeocc3d, {about}",
        f"image: {image.name}",
        "mode: trinary",
        f"resolution: {size:.12g}",
        f"origin: [{origin[0]:.9g}, {origin[1]:.9g}, 0.0]",
        "negate: 0",
        f"occupied_thresh: {occupied}",
        f"free_thresh: {free}",
    ]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _avoided(entries: tuple[str, ...]) -> dict[str, float]:
    """Word -> metres to keep from it. Raises ConfigError."""
    found = {}
    for entry in entries:
        word, separator, distance = entry.partition(":")
        try:
            metres = float(distance) if separator else 0.0
        except ValueError:
            metres = -1.0
        if not 0 <= metres < np.inf:
            raise ConfigError(f"'avoid' takes words with metres to keep from them, as in glass:0.5, got '{entry}'.")
        found[word.strip()] = metres
    if len({_file_part(word) for word in found}) < len(found):
        raise ConfigError("'avoid' names two words whose layers would have the same file name: leave one out.")
    return found


def _write_layers(
    scan_map: Map,
    path: Path,
    there: Placed,
    avoided: dict[str, float],
    shape: tuple[int, ...],
    origin: NDArray[np.float64],
) -> list[dict[str, Any]]:
    """Write a mask for each word, over the plan's cells, and say what was written."""
    if not avoided:
        return []
    occupancy, layers = there.occupancy, []
    offset = np.rint((origin - occupancy.origin[:2]) / occupancy.voxel_size).astype(np.int64)
    cell = occupancy.occupied_voxels()[:, :2] - offset
    for result, (word, metres) in zip(scan_map.query_words(list(avoided)), avoided.items(), strict=True):
        rows = np.concatenate([region.rows for region in result.regions] or [np.zeros(0, np.int64)])
        inside = np.isin(there.rows, rows) & ((cell >= 0) & (cell < shape)).all(axis=1)
        mask = np.full(shape, FREE, np.uint8)
        mask[tuple(cell[inside].T)] = OCCUPIED
        layer = path.with_name(f"{path.stem}.{_file_part(word)}.yaml")
        about = f"{there.frame} frame; {metres:g} m around {json.dumps(word)}"
        _write_map(layer, inflated(mask, metres / occupancy.voxel_size), origin, occupancy.voxel_size, about)
        layers.append({"word": word, "distance_m": metres, "matched": bool(inside.any()), "file": layer.name})
    return layers


def _file_part(word: str) -> str:
    return re.sub(r"\W+", "_", word.strip()) or "_"


def plan(
    occupancy: Occupancy, low: float, high: float, min_free: float
) -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
    """(X, Y) FREE, OCCUPIED or UNKNOWN of the columns over the known voxels' box, from the voxels of one size whose
    centres lie between two heights z, and the (2,) lower corner of cell (0, 0), metres. Raises ExportError."""
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


def inflated(cells: NDArray[np.uint8], radius: float) -> NDArray[np.uint8]:
    """The plan with every cell within ``radius`` cells of an occupied one occupied."""
    from scipy import ndimage

    if not (cells == OCCUPIED).any():
        return cells
    near = ndimage.distance_transform_edt(cells != OCCUPIED) <= radius
    return np.where(near, OCCUPIED, cells).astype(np.uint8)


def write_pgm(path: Path, cells: NDArray[np.uint8]) -> None:
    """Write (X, Y) states as the image that map_server reads: x to the right, y upwards. Raises OSError."""
    pixels = np.zeros(256, np.uint8)
    pixels[list(_PIXEL)] = list(_PIXEL.values())
    rows = pixels[cells].T[::-1]
    header = f"P5\n{rows.shape[1]} {rows.shape[0]}\n255\n"
    path.write_bytes(header.encode("ascii") + np.ascontiguousarray(rows).tobytes())
