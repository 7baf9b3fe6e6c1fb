"""Writes the pair of files that ROS map_server reads: NAME.yaml and NAME.pgm.

`origin` is the lower left corner of the lower left pixel. The top row of the image has the largest y.
Source: nav2_map_server's map_io.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml
from numpy.typing import NDArray


@dataclass(frozen=True)
class CellGrid:
    """The places of cells: cell (i, j) covers x = origin[0] + [i, i + 1) * size, meters, and y likewise with j.

    origin: (2,) lower corner of cell (0, 0).  frame: name of the frame of the coordinates.
    """

    origin: NDArray[np.float64]
    size: float
    shape: tuple[int, int]
    frame: str


@dataclass(frozen=True)
class Reading:
    """How map_server reads a pixel p. With o = 1 - p / 255, it is occupied (100) if o > occupied, and free (0) if o <
    free. Between them it is unknown (-1) in mode "trinary"; in mode "scale" it is the percentage of the way from free
    to occupied.
    """

    mode: str
    occupied: float
    free: float


PLAN = Reading("trinary", 0.65, 0.196)
"""An unknown pixel, 205, is 0.19608, so a threshold of 0.196 does not read it as free."""
COSTS = Reading("scale", 0.999, 0.001)
"""White is 0 and black is 100; map_server reads the pixels of ``encode_costs`` as the costs."""


def encode_costs(costs: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Returns the pixels that read as costs 0…100 with COSTS."""
    return np.rint(255 - 2.55 * costs.astype(np.float64)).astype(np.uint8)


def write_map(path: Path, pixels: NDArray[np.uint8], grid: CellGrid, reading: Reading, about: str) -> None:
    """Writes ``path``, a .yaml, and the image of (X, Y) pixels next to it: x to the right, y up. Raises OSError."""
    image = path.with_suffix(".pgm")
    rows = np.ascontiguousarray(pixels.T[::-1])
    image.write_bytes(f"P5\n{rows.shape[1]} {rows.shape[0]}\n255\n".encode("ascii") + rows.tobytes())
    lines = [
        f"# freeocc3d, {grid.frame} frame; {about}",
        yaml.safe_dump({"image": image.name}, allow_unicode=True, width=1 << 16).strip(),
        f"mode: {reading.mode}",
        f"resolution: {grid.size:.12g}",
        f"origin: [{grid.origin[0]:.9g}, {grid.origin[1]:.9g}, 0.0]",
        "negate: 0",
        f"occupied_thresh: {reading.occupied}",
        f"free_thresh: {reading.free}",
    ]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
