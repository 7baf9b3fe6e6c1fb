"""Gaussians as an Open3D tensor point cloud with named attributes, and its PLY file."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..core.errors import FreeOccError, MapError
from ..core.ply_files import read_ply_vertices
from ..core.types import Gaussians

if TYPE_CHECKING:
    import open3d as o3d

_ATTRIBUTES = {
    "scale": ("scales", 3, np.float32),
    "rotation": ("quats_wxyz", 4, np.float32),
    "opacity": ("opacities", 1, np.float32),
    "keyframe": ("anchor_keyframe", 1, np.int32),
    "anchor": ("anchor_cam", 3, np.float32),
}
"""Point attribute -> (field, columns, type), in addition to ``positions`` and ``colors``."""

_FARTHEST, _UNIT = 1e9, 1e-2

_BYTES = 67  # per Gaussian: 14 float32, 2 int32, 3 uint8


def to_point_cloud(gaussians: Gaussians) -> o3d.t.geometry.PointCloud:
    """Makes a point cloud whose attributes share memory with the arrays. The id of a Gaussian, which its features refer
    to, is its row; the attribute ``feature`` carries it, so that it survives a selection of points."""
    import open3d as o3d

    cloud = o3d.t.geometry.PointCloud(_tensor(gaussians.means))
    cloud.point["colors"] = _tensor(gaussians.colors)
    for name, (field, columns, _) in _ATTRIBUTES.items():
        cloud.point[name] = _tensor(getattr(gaussians, field).reshape(len(gaussians), columns))
    cloud.point["feature"] = _tensor(np.arange(len(gaussians), dtype=np.int32)[:, None])
    return cloud


def _from_columns(columns: dict[str, np.ndarray]) -> Gaussians:
    fields = {"means": _take(columns, "positions", 3, np.float32), "colors": _take(columns, "colors", 3, np.uint8)}
    for name, (field, width, dtype) in _ATTRIBUTES.items():
        values = _take(columns, name, width, dtype)
        fields[field] = values[:, 0] if width == 1 else values
    return Gaussians(**fields)


def write_gaussian_ply(gaussians: Gaussians, path: Path) -> None:
    """Writes the point cloud as binary PLY. Raises OSError, or MapError if the file could not be written completely."""
    import open3d as o3d

    size = _BYTES * len(gaussians)
    with path.open("wb") as stream:
        # On a full disk, Open3D reports each property that it cannot write. Find out first.
        os.posix_fallocate(stream.fileno(), 0, size + 4096)
    written = len(gaussians) > 0 and o3d.t.io.write_point_cloud(str(path), to_point_cloud(gaussians))
    if not written or path.stat().st_size < size:
        raise MapError(f"Cannot write {path}: there are no Gaussians to write, or the disk is full.")


def read_gaussian_ply(path: Path, keyframes: int | None = None) -> Gaussians:
    """Reads a file of ``write_gaussian_ply``.

    keyframes: how many the Gaussians may be anchored to; None = any. Raises MapError: a damaged file, another length
    than its header states, or a value that no Gaussian can have.
    """
    try:
        rows = read_ply_vertices(path, alone=True)
    except FreeOccError as error:
        raise MapError(str(error)) from error
    try:
        gaussians = _from_rows(rows)
    except MapError as error:
        raise MapError(f"{path} is damaged: {error}") from error
    if problem := _problem(gaussians, keyframes):
        raise MapError(f"{path} is damaged: it holds {problem}.")
    return gaussians


def _problem(gaussians: Gaussians, keyframes: int | None) -> str:
    """What no Gaussian of a map can have; empty if there is nothing of the kind."""
    lengths = np.linalg.norm(gaussians.quats_wxyz.astype(np.float64), axis=1)
    anchors = gaussians.anchor_keyframe
    checks = {
        "means that are not finite": np.isfinite(gaussians.means).all(),
        "means that are too far away": np.abs(gaussians.means).max(initial=0) <= _FARTHEST,
        "scales that are not positive": ((gaussians.scales > 0) & (gaussians.scales <= _FARTHEST)).all(),
        "rotations that are no unit quaternions": (np.abs(lengths - 1) <= _UNIT).all(),
        "opacities outside 0 to 1": ((gaussians.opacities >= 0) & (gaussians.opacities <= 1)).all(),
        "anchors that are not finite": (np.abs(gaussians.anchor_cam) <= _FARTHEST).all(),
        "anchors in keyframes that the map does not have": keyframes is None
        or ((anchors >= 0) & (anchors < keyframes)).all(),
    }
    return next((what for what, right in checks.items() if not right), "")


def _from_rows(rows: NDArray[np.void]) -> Gaussians:
    columns = {name: np.ascontiguousarray(rows[name])[:, None] for name in rows.dtype.names or ()}
    for name, parts in (("positions", "xyz"), ("colors", ("red", "green", "blue"))):
        if all(part in columns for part in parts):
            columns[name] = np.concatenate([columns[part] for part in parts], axis=1)
    return _from_columns(columns)


def _take(columns: dict[str, np.ndarray], name: str, width: int, dtype: type) -> np.ndarray:
    """An attribute as (N, width): whole, or joined from the columns name_0, name_1, … of a PLY file."""
    if name not in columns:
        parts = [f"{name}_{i}" for i in range(width)]
        if any(part not in columns for part in parts):
            raise MapError(f"the Gaussians lack the attribute '{name}'.")
        values = np.concatenate([columns[part] for part in parts], axis=1)
    elif columns[name].shape[1] == width:
        values = columns[name]
    else:
        raise MapError(f"the attribute '{name}' has {columns[name].shape[1]} columns instead of {width}.")
    if values.dtype != dtype:
        raise MapError(f"the attribute '{name}' is of type {values.dtype} instead of {np.dtype(dtype)}.")
    return values


def _tensor(array: np.ndarray) -> o3d.core.Tensor:
    import open3d as o3d

    return o3d.core.Tensor.from_numpy(np.ascontiguousarray(array))
