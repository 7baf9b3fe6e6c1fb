"""Gaussians as a standard 3D Gaussian splatting PLY, as viewers and editors of splats read it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..core.errors import ExportError
from ..query.scan_map import Map
from ..settings.typed_options import TypedOptions
from .export_frames import Frame, to_frame, write_description

REQUIRES: tuple[str, ...] = ()
ENDINGS = (".ply",)


class Options(TypedOptions, frozen=True):
    """Frame and orientation. NAME.json next to the file holds the transform from the map."""

    upright: bool = True
    """Turn the frame so that up is -y, as viewers of such files expect; false = keep the frame's axes."""
    frame: Frame = "map"
    """"map", "gravity" (floor at 0), "start" (z up, first camera at the origin) or "first-camera" (its own)."""


def write(scan_map: Map, path: Path, options: Options) -> None:
    """Writes the Gaussians. Raises ExportError for a map without Gaussians."""
    from ..gaussians.anchors import align_gaussians
    from ..gaussians.splat_ply import write_standard_ply

    gaussians = scan_map.gaussians
    if len(gaussians) == 0:
        raise ExportError("The map has no Gaussians to write.")
    T_file_map = to_frame(scan_map, options.frame)
    if options.upright:
        own = options.frame in ("map", "first-camera")
        up = T_file_map[:3, :3] @ scan_map.up if own else np.array((0.0, 0.0, 1.0))
        turn = np.eye(4)
        turn[:3, :3] = _to_minus_y(up)
        T_file_map = turn @ T_file_map
    if not np.array_equal(T_file_map, np.eye(4)):
        gaussians = align_gaussians(gaussians, 1.0, T_file_map[:3, :3], T_file_map[:3, 3])
    write_standard_ply(gaussians, path)
    told = {"frame": options.frame, "up": "-y" if options.upright else "the frame's"}
    write_description(path, {**told, "metric": scan_map.metric, "T_file_map": T_file_map.tolist()})


def _to_minus_y(up: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns the least rotation (3, 3) that takes a unit vector to (0, -1, 0); half a turn about x for (0, 1, 0)."""
    target = np.array((0.0, -1.0, 0.0))
    axis, cosine = np.cross(up, target), float(up @ target)
    if cosine < -1 + 1e-9:
        return np.diag((1.0, -1.0, -1.0))
    K = np.cross(np.eye(3), axis)
    return np.asarray(np.eye(3) + K + K @ K / (1 + cosine))
