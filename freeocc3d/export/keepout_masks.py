"""Costs of words for planners: masks for Nav2's KeepoutFilter, over the cells of a plan.

A mask holds 0 where no word has a cost, 100 where a robot must not go, and 1 to 99 where it may go at that cost.
Nav2 uses these values unchanged with `type: 0, base: 0.0, multiplier: 1.0` of its costmap filter info server.
Source: nav2_costmap_2d's KeepoutFilter, nav2_map_server's map_io.
"""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.errors import ConfigError, ExportError
from ..query.scan_map import Map
from .export_frames import PlacedVoxels
from .map_server_files import COSTS, CellGrid, encode_costs, write_map

TOGETHER = "avoid"
"""Name of the mask of all words together."""
_FORBIDDEN = 100
_FARTHEST = 1000.0  # meters
_SYNTAX = "as in carpet, glass:0.5 (meters to keep from it) or plant:0.5:60% (a cost that falls off over them)"


@dataclass(frozen=True)
class Avoided:
    """A word, the distance to keep from it in meters, and the cost of going there in percent; 100 forbids it."""

    word: str
    meters: float = 0.0
    cost: int = _FORBIDDEN

    @property
    def file_part(self) -> str:
        """The word as a part of a file name."""
        return re.sub(r"\W+", "_", self.word) or "_"


def parse_avoided(entries: Sequence[str]) -> list[Avoided]:
    """Reads ``WORD``, ``WORD:METERS``, ``WORD:COST%`` or ``WORD:METERS:COST%``. Raises ConfigError."""
    found = [_parsed(entry) for entry in entries]
    parts = [TOGETHER, *(avoided.file_part for avoided in found)]
    if len(set(parts)) < len(parts):
        raise ConfigError(
            "'avoid' names two words whose masks get the same file name, or a word whose mask gets the same file name "
            f"as the mask of all words, '{TOGETHER}': leave one word out."
        )
    return found


def _parsed(entry: str) -> Avoided:
    word, *numbers = (part.strip() for part in entry.split(":"))
    try:
        cost = float(numbers.pop().removesuffix("%")) if numbers and numbers[-1].endswith("%") else float(_FORBIDDEN)
        meters = float(numbers.pop()) if numbers else 0.0
    except ValueError:
        meters = cost = np.nan
    if not word or numbers or not (0 <= meters <= _FARTHEST and 1 <= cost <= _FORBIDDEN and cost == int(cost)):
        raise ConfigError(f"'avoid' takes words, {_SYNTAX}, with whole costs from 1 to 100; got '{entry}'.")
    return Avoided(word, meters, int(cost))


def write_layers(
    scan_map: Map, path: Path, there: PlacedVoxels, avoided: Sequence[Avoided], grid: CellGrid, highest: float
) -> tuple[list[dict[str, Any]], list[str]]:
    """Writes a mask for each word and one for all words: NAME.WORD.yaml and NAME.avoid.yaml for a plan NAME.yaml.
    Returns what it wrote, and a sentence for each word that is nowhere (its mask is empty) or only partly understood.

    highest: z in the frame up to which a thing counts; a robot drives under higher things. Raises ExportError for a
    word that the map does not understand: an empty mask would say that there is nothing to avoid.
    """
    if not avoided:
        return [], []
    voxels = there.occupancy.occupied_voxels()
    low = there.occupancy.centers(voxels)[:, 2] <= highest
    offset = np.rint((grid.origin - there.occupancy.origin[:2]) / grid.size).astype(np.int64)
    every = max(len(scan_map.occupancy.colors), 1)
    results = scan_map.query_words([one.word for one in avoided], objects=False, top_k=every)
    together, layers, notes = np.zeros(grid.shape, np.uint8), [], []
    for one, result in zip(avoided, results, strict=True):
        if not result.understood:
            raise ExportError(result.note)
        rows = np.concatenate([region.rows for region in result.regions] or [np.zeros(0, np.int64)])
        inside = np.isin(there.rows, rows) & low
        costs = compute_cost_map(voxels[inside, :2] - offset, grid.shape, grid.size, one)
        if not inside.any():
            why = result.note if not len(rows) else f"All of '{one.word}' lies above the robot's height."
            notes.append(f"{why} Its mask {path.stem}.{one.file_part}.yaml is empty.")
        elif result.note:  # only a part of the word was understood
            notes.append(result.note)
        layer = path.with_name(f"{path.stem}.{one.file_part}.yaml")
        about = f"costs of {json.dumps(one.word)}: {_about(one)}"
        write_map(layer, encode_costs(costs), grid, COSTS, f"{about}; for Nav2's KeepoutFilter")
        told = {"word": one.word, "distance_m": one.meters, "cost": one.cost}
        layers.append({**told, "matched": bool(inside.any()), "file": layer.name})
        together = np.maximum(together, costs)
    everything = path.with_name(f"{path.stem}.{TOGETHER}.yaml")
    about = f"costs of {', '.join(json.dumps(one.word) for one in avoided)} together; for Nav2's KeepoutFilter"
    write_map(everything, encode_costs(together), grid, COSTS, about)
    return layers, notes


def compute_cost_map(
    cells: NDArray[np.int64], shape: tuple[int, int], size: float, avoided: Avoided
) -> NDArray[np.uint8]:
    """Returns the (X, Y) costs 0…100 around (N, 2) cells, which may lie outside of the plan. A cost of 100 holds within
    the whole distance; a lower cost falls off evenly over it. Distances are Euclidean, between the cells' centers."""
    from scipy import ndimage

    costs = np.zeros(shape, np.uint8)
    if not len(cells):
        return costs
    reach = int(np.ceil(avoided.meters / size))
    near = cells[((cells >= -reach) & (cells < np.array(shape) + reach)).all(axis=1)]
    if not len(near):
        return costs
    low = np.minimum(near.min(axis=0), 0)
    away = np.ones(np.maximum(near.max(axis=0) + 1, shape) - low, bool)
    away[tuple((near - low).T)] = False
    part = tuple(slice(-first, -first + length) for first, length in zip(low, shape, strict=True))
    distance = size * np.asarray(ndimage.distance_transform_edt(away))[part]
    if avoided.cost == _FORBIDDEN:
        return np.where(distance <= avoided.meters * (1 + 1e-9), _FORBIDDEN, 0).astype(np.uint8)
    share = np.clip(1 - distance / avoided.meters, 0, 1) if avoided.meters > 0 else distance == 0
    return np.rint(avoided.cost * share).astype(np.uint8)


def _about(avoided: Avoided) -> str:
    fall = "within" if avoided.cost == _FORBIDDEN else "falling to 0 over"
    return f"{avoided.cost}" + (f", {fall} {avoided.meters:g} m" if avoided.meters else "")
