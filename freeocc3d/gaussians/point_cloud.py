"""Gaussians as an Open3D tensor point cloud with named attributes, and its PLY file."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

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


def read_gaussian_ply(path: Path) -> Gaussians:
    """Reads a file of ``write_gaussian_ply``. Raises MapError."""
    try:
        rows = read_ply_vertices(path)
    except FreeOccError as error:
        raise MapError(str(error)) from error
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
            raise MapError(f"The Gaussians lack the attribute '{name}'.")
        return np.concatenate([columns[part] for part in parts], axis=1).astype(dtype)
    return np.asarray(columns[name].reshape(-1, width), dtype)


def _tensor(array: np.ndarray) -> o3d.core.Tensor:
    import open3d as o3d

    return o3d.core.Tensor.from_numpy(np.ascontiguousarray(array))
