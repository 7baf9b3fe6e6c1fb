"""Gaussians as a standard 3D Gaussian splatting PLY, as viewers and editors of splats read it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import ExportError
from ..store import Map

REQUIRES: tuple[str, ...] = ()


@dataclass(frozen=True)
class Options:
    """Orientation."""

    upright: bool = True
    """Turn the map so that up is -y, as viewers of such files expect; false = the map's own frame, whose first camera
    looks along +z with y down."""


def write(scan_map: Map, path: Path, options: Options) -> None:
    """Write the Gaussians. Raises ExportError for a map without any."""
    from ..gaussians.anchors import aligned
    from ..gaussians.standard_ply import write_standard_ply

    gaussians = scan_map.gaussians
    if len(gaussians) == 0:
        raise ExportError("The map has no Gaussians to write.")
    if options.upright:
        gaussians = aligned(gaussians, 1.0, _to_minus_y(scan_map.up), np.zeros(3))
    write_standard_ply(gaussians, path)


def _to_minus_y(up: NDArray[np.float64]) -> NDArray[np.float64]:
    """The least rotation (3, 3) that takes a unit vector to (0, -1, 0); half a turn about x where that is opposite."""
    target = np.array((0.0, -1.0, 0.0))
    axis, cosine = np.cross(up, target), float(up @ target)
    if cosine < -1 + 1e-9:
        return np.diag((1.0, -1.0, -1.0))
    K = np.cross(np.eye(3), axis)
    return np.asarray(np.eye(3) + K + K @ K / (1 + cosine))
