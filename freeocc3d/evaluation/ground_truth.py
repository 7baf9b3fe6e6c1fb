"""Reads and writes ground truth: ``ground_truth.npz``, and the packages that data sets publish."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.arrays import read_arrays
from ..core.atomic_files import write_whole
from ..core.errors import FreeOccError, MapError
from ..core.types import UNKNOWN
from .embodiedocc import load_global_package
from .true_occupancy import GroundTruth

_NAMES = (
    "labels", "classes", "frames_mask", "origin", "voxel_size", "occupancy", "T_world_map", "T_frame_map", "means",
    "scales", "quats_wxyz", "opacities", "semantics",
)  # fmt: skip
_MOST_BYTES, _FARTHEST = (1 << 30) + (1 << 22), 1e9


def load_ground_truth(path: str | Path, classes: tuple[str, ...] | None = None) -> GroundTruth:
    """Reads ``ground_truth.npz`` or a data set's ``global_occ_package/<scene>.pkl``. It reads arrays only and runs no
    code.

    classes: names of the labels 0, 1, … for a package without names.
    Raises FreeOccError: no such file, a damaged file, an array that is missing or differs in shape or type from
    ``GroundTruth``, a label without a class.
    """
    path = Path(path)
    if path.suffix == ".pkl":
        return load_global_package(path, classes)
    arrays = read_grid_arrays(path)
    labels = require_array(arrays, "labels", path)
    names = require_array(arrays, "classes", path)
    if labels.dtype != np.uint8 or labels.ndim != 3:
        raise FreeOccError(f"'labels' of {path} must be uint8 (X, Y, Z), got {labels.dtype} {labels.shape}.")
    if names.dtype.kind != "U" or names.ndim != 1:
        raise FreeOccError(f"'classes' of {path} must be a list of names, got {names.dtype} {names.shape}.")
    largest = int(labels.max(initial=0, where=labels != UNKNOWN))
    if largest >= max(len(names), 1):
        raise FreeOccError(f"'labels' of {path} hold class {largest}, but only {len(names)} classes have names.")
    mask = arrays.get("frames_mask")
    if mask is not None and (mask.dtype != np.bool_ or mask.shape != labels.shape):
        raise FreeOccError(f"'frames_mask' of {path} must be bool {labels.shape}, got {mask.dtype} {mask.shape}.")
    return GroundTruth(labels, *read_lattice(arrays, path), tuple(names.tolist()), mask)


def save_ground_truth(truth: GroundTruth, path: Path, overwrite: bool = False) -> None:
    """Writes ``ground_truth.npz``. Raises ExportError: the file exists, or cannot be written."""
    arrays: dict[str, Any] = {
        "labels": truth.labels,
        "origin": truth.origin,
        "voxel_size": np.float64(truth.voxel_size),
        "classes": np.array(truth.classes),
    }
    if truth.frames_mask is not None:
        arrays["frames_mask"] = truth.frames_mask

    def write(target: Path) -> None:
        with target.open("wb") as stream:
            np.savez_compressed(stream, **arrays)

    write_whole(path, write, overwrite)


def read_grid_arrays(path: Path) -> dict[str, NDArray[Any]]:
    """Returns the arrays of an .npz file that hold a grid or Gaussians, by name, after a check of their sizes. Raises
    FreeOccError."""
    if not path.is_file():
        raise FreeOccError(f"Cannot read {path}: there is no such file.")
    if not zipfile.is_zipfile(path):
        raise FreeOccError(f"{path} is damaged or not an .npz file of named arrays.")
    try:
        return read_arrays(path, {}, _NAMES, _MOST_BYTES)
    except MapError as error:
        raise FreeOccError(str(error)) from error


def read_lattice(arrays: dict[str, NDArray[Any]], path: Path) -> tuple[NDArray[np.float64], float]:
    """Returns origin (3,) and voxel size of a grid, meters. Raises FreeOccError."""
    origin = require_array(arrays, "origin", path)
    size = require_array(arrays, "voxel_size", path)
    if origin.dtype.kind != "f" or origin.shape != (3,) or not (np.abs(origin) <= _FARTHEST).all():
        raise FreeOccError(f"'origin' of {path} must be three finite numbers in meters.")
    if size.dtype.kind != "f" or size.shape != () or not 1e-3 <= size <= 10:
        raise FreeOccError(f"'voxel_size' of {path} must be one number of meters, from 0.001 to 10.")
    return origin.astype(np.float64), float(size)


def require_array(arrays: dict[str, NDArray[Any]], name: str, path: Path) -> NDArray[Any]:
    """Returns the named array. Raises FreeOccError if it is missing."""
    if name not in arrays:
        raise FreeOccError(f"{path} has no '{name}'; it holds {', '.join(arrays) or 'nothing'}.")
    return arrays[name]
