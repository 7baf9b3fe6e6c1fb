"""Reads and writes the PLY files of 3D Gaussian splatting (SplaTAM, MonoGS, Photo-SLAM, viewers, …).

Format: B. Kerbl et al., 3D Gaussian Splatting, SIGGRAPH 2023: ``x y z``, ``f_dc_0..2`` with rgb = 0.5 + f_dc / (2
sqrt(pi)), ``opacity`` as a logit, ``scale_*`` as natural logarithms (one if the Gaussians are spheres), ``rot_0..3``
wxyz, not always of unit length.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..core.errors import FreeOccError
from ..core.ply_files import read_ply_header, read_ply_vertices, write_ply
from ..core.types import Gaussians

_SH_C0 = 0.5 / math.sqrt(math.pi)
_LEAST_OPACITY = 1e-6  # its logit, and the logit of 1 minus it, are finite
_MOST_LABELS = 1 << 31
_NEEDED = ("x", "y", "z", "opacity", "scale_0", "rot_0", "rot_1", "rot_2", "rot_3")


def read_standard_ply(path: Path) -> tuple[Gaussians, NDArray[np.int64] | None]:
    """Reads the Gaussians of a 3DGS PLY in its own world, and (N,) the values of its property ``label``, if it has one.

    Leaves out Gaussians with a value that is not finite, or without any extent. The Gaussians are anchored to no
    keyframe. Raises FreeOccError if the file does not exist, is damaged, or lacks a property.
    """
    rows = _rows(path)
    names = rows.dtype.names or ()
    means = _columns(rows, ["x", "y", "z"])
    scales = [f"scale_{i}" for i in range(3)] if "scale_1" in names else ["scale_0"] * 3  # spheres
    quats = _columns(rows, [f"rot_{i}" for i in range(4)])
    colors = np.full((len(rows), 3), 128, np.uint8)
    if "f_dc_0" in names:
        rgb = 0.5 + _SH_C0 * _columns(rows, [f"f_dc_{i}" for i in range(3)])
        colors = np.rint(255 * np.clip(np.nan_to_num(rgb), 0, 1)).astype(np.uint8)
    with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
        gaussians = Gaussians(
            means=means.astype(np.float32),
            scales=np.exp(_columns(rows, scales)).astype(np.float32),
            quats_wxyz=(quats / np.linalg.norm(quats, axis=1, keepdims=True)).astype(np.float32),
            opacities=(1.0 / (1.0 + np.exp(-_columns(rows, ["opacity"])[:, 0]))).astype(np.float32),
            colors=colors,
            anchor_keyframe=np.full(len(rows), -1, np.int32),
            anchor_cam=means.astype(np.float32),
        )
    finite = np.isfinite(gaussians.opacities) & (gaussians.scales > 0).all(axis=1)
    for values in (gaussians.means, gaussians.scales, gaussians.quats_wxyz):
        finite &= np.isfinite(values).all(axis=1)
    return gaussians[finite], _labels(rows["label"][finite]) if "label" in names else None


def _labels(values: NDArray[np.generic]) -> NDArray[np.int64]:
    """Labels as whole numbers; -1, which is no label, for values that are none."""
    if values.dtype.kind != "f":
        return values.astype(np.int64)
    return np.where(np.abs(values) < _MOST_LABELS, np.nan_to_num(values), -1).astype(np.int64)


def write_standard_ply(gaussians: Gaussians, path: Path) -> None:
    """Writes N Gaussians in their current frame, with spherical harmonics of degree 0 only. Raises OSError."""
    names = [
        *("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"),
        *(f"scale_{i}" for i in range(3)),
        *(f"rot_{i}" for i in range(4)),
    ]
    opacities = np.clip(gaussians.opacities.astype(np.float64), _LEAST_OPACITY, 1 - _LEAST_OPACITY)
    columns = (
        gaussians.means,
        np.zeros((len(gaussians), 3)),
        (gaussians.colors / 255.0 - 0.5) / _SH_C0,
        np.log(opacities / (1 - opacities))[:, None],
        np.log(gaussians.scales.astype(np.float64)),
        gaussians.quats_wxyz,
    )
    table = np.ascontiguousarray(np.concatenate(columns, axis=1), "<f4")
    write_ply(path, table.view([(name, "<f4") for name in names])[:, 0])


def _columns(rows: NDArray[np.void], names: list[str]) -> NDArray[np.float64]:
    """(N, K) the named properties."""
    return np.stack([rows[name].astype(np.float64) for name in names], axis=1)


def _rows(path: Path) -> NDArray[np.void]:
    """(N,) the vertices as records of their properties."""
    names = [line[-1] for line in read_ply_header(path).elements[0][2]]
    if missing := [name for name in _NEEDED if name not in names]:
        hint = " It is an internal file of a map: evaluate the map's folder instead." if "anchor_0" in names else ""
        raise FreeOccError(f"{path} is not a 3D Gaussian splatting PLY: its vertices lack {', '.join(missing)}.{hint}")
    return read_ply_vertices(path)
