"""Reads published ground truth: the packages of EmbodiedOcc-ScanNet and ReplicaOcc.

    global_occ_package/<scene>.pkl                              a scene's labeled grid
    streme_occ_new_package/{train,test,val}/<scene>_<idx>_new.pkl   which of its voxels a frame sees

Sources of the layout: the loaders that the projects publish. Wu et al., EmbodiedOcc, ICCV 2025 (global package and
masks of frames); FreeOcc, RSS 2026 (ReplicaOcc, with class names outside its packages).
"""

from __future__ import annotations

import difflib
import glob
import math
import re
from collections.abc import Sequence
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.errors import FreeOccError
from ..core.regular_files import read_text
from ..core.typed_documents import parse_json
from ..core.types import UNKNOWN
from .restricted_unpickler import load_pickle, shorten
from .scored_classes import EMBODIEDOCC
from .true_occupancy import GroundTruth

EMBODIEDOCC_CLASSES = ("free", *EMBODIEDOCC)
"""Names of the labels 0 … 11 of Occ-ScanNet and EmbodiedOcc-ScanNet."""

GLOBAL_FOLDER, FRAMES_FOLDER = "global_occ_package", "streme_occ_new_package"

_SPLITS = ("train", "test", "val")

_FARTHEST = 1e6
"""Meters; larger coordinates, infinity and NaN are damage."""


def load_global_package(path: Path, classes: tuple[str, ...] | None = None) -> GroundTruth:
    """Reads a scene of EmbodiedOcc-ScanNet or ReplicaOcc: ``global_occ_package/<scene>.pkl``.

    classes: names of the labels, for a package that has no names itself (under ``classes`` or ``class_names``) and does
    not have EmbodiedOcc's labels. The first name, of label 0, is not used.
    ``global_pts`` are voxel centers, in the frame of the true poses. ``global_mask`` is not used: neither EmbodiedOcc
    nor FreeOcc score by it. If ``streme_occ_new_package`` lies next to the package's folder and has frames of the
    scene, they give ``frames_mask``.
    Raises FreeOccError: unreadable, an array missing or of another form, an irregular grid, a label without a name.
    """
    package = _load_dict(path)
    shape = _shape(package, path)
    origin, voxel_size = _lattice(_array(package, "global_pts", path), shape, path)
    labels = _labels(_on_grid(_array(package, "global_labels", path), shape, "global_labels", path), path)
    highest = int(labels.max(initial=0, where=labels != UNKNOWN))
    names = _class_names(package, path) or EMBODIEDOCC_CLASSES
    if highest >= len(names):
        names = classes or names
    if highest >= len(names):
        raise FreeOccError(
            f"'global_labels' of {path} hold class {highest}, but only {len(names) - 1} classes have names: give the "
            "names of all classes of the data set, in its order, with --classes."
        )
    folder = path.absolute().parent.parent / FRAMES_FOLDER
    mask_of_frames = load_frames_mask(folder, path.stem, shape, _frame_names(package, path))
    return GroundTruth(labels, origin, voxel_size, names, mask_of_frames)


def load_frames_mask(
    folder: Path, scene: str, shape: tuple[int, int, int], frames: Sequence[str] | None = None
) -> NDArray[np.bool_] | None:
    """Returns the (X, Y, Z) union of ``mask_in_global`` over a scene's frames; None if the folder has none of them.

    folder: ``streme_occ_new_package``.  frames: names of the frames, such as "00012"; None = all in the folder.
    Raises FreeOccError: some of the frames are missing, a file is damaged, a mask does not fit the scene's grid.
    """
    pattern = re.compile(rf"{re.escape(scene)}_(\d+)_new\.pkl")
    found: dict[str, Path] = {}
    for split in _SPLITS:
        for name in glob.glob(f"{glob.escape(scene)}_*_new.pkl", root_dir=folder / split):
            if match := pattern.fullmatch(name):
                found[match[1]] = folder / split / name
    if not found:
        return None
    frames = sorted(found) if frames is None else frames
    if missing := [frame for frame in frames if frame not in found]:
        raise FreeOccError(
            f"{folder} lacks {len(missing)} of the {len(frames)} frames of {scene}, the first {missing[0]}: unpack the "
            "whole data set."
        )
    union = np.zeros(shape, bool)
    for frame in frames:
        path = found[frame]
        _add_mask(union, _array(_load_dict(path), "mask_in_global", path), path)
    return union


def read_split(path: Path) -> list[str]:
    """Reads the scenes of a split, each once, in the file's order.

    The file is a text with one entry per line, without empty lines and ``#`` comments, or a JSON list of entries. An
    entry is ``<scene>``, ``<scene>_<frame>`` or a path that ends in one. Raises FreeOccError: no such file, an entry
    without a scene, no entries.
    """
    try:
        text = read_text(path)
        entries = parse_json(text) if path.suffix == ".json" else [line.split("#")[0] for line in text.splitlines()]
    except OSError as error:
        raise FreeOccError(f"Cannot read the split {path}: {(error.strerror or str(error)).lower()}.") from error
    except ValueError as error:
        raise FreeOccError(f"The split {path} is damaged: it is not UTF-8 text or not valid JSON.") from error
    if not isinstance(entries, list) or not all(isinstance(entry, str) for entry in entries):
        raise FreeOccError(f"The split {path} must be a list of scene names.")
    scenes = [_scene_of(entry.strip(), path) for entry in entries if entry.strip()]
    if not scenes:
        raise FreeOccError(f"The split {path} names no scene.")
    return list(dict.fromkeys(scenes))


def find_package(folder: Path, scene: str) -> Path:
    """Returns the path ``<folder>/<scene>.pkl`` or ``<folder>/global_occ_package/<scene>.pkl``.

    Raises FreeOccError: the package is missing (the message lists the nearest names), ``scene`` is not a plain name.
    """
    if not re.fullmatch(r"\w[\w.-]*", scene):
        raise FreeOccError(f"'{scene}' is not the name of a scene, such as scene0000_00 or room0.")
    places = (folder, folder / GLOBAL_FOLDER)
    for place in places:
        if (place / f"{scene}.pkl").is_file():
            return place / f"{scene}.pkl"
    there = sorted({path.stem for place in places for path in place.glob("*.pkl")})
    nearest = difflib.get_close_matches(scene, there, n=3, cutoff=0.0)
    known = f"the nearest are {', '.join(nearest)}" if nearest else "it has no packages"
    raise FreeOccError(f"{folder} has no package of {scene}, in the folder itself or in {GLOBAL_FOLDER}: {known}.")


def _load_dict(path: Path) -> dict[Any, Any]:
    package = load_pickle(path)
    if not isinstance(package, dict):
        raise FreeOccError(f"{path} is not a package: it holds a {type(package).__name__} in place of named arrays.")
    return package


def _value(package: dict[Any, Any], key: str, path: Path) -> Any:
    if key not in package:
        there = ", ".join(name for name in package if isinstance(name, str)) or "nothing by name"
        raise FreeOccError(f"{path} has no '{key}'; it holds {shorten(there)}.")
    return package[key]


def _array(package: dict[Any, Any], key: str, path: Path) -> NDArray[Any]:
    value = _value(package, key, path)
    if not isinstance(value, np.ndarray):
        raise FreeOccError(f"'{key}' of {path} must be an array, got a {type(value).__name__}.")
    return np.asarray(value)


def _triple(package: dict[Any, Any], key: str, path: Path) -> list[float]:
    """Returns three finite numbers from an array or a plain list."""
    value = _value(package, key, path)
    numbers: Any = value.tolist() if isinstance(value, np.ndarray) and value.size == 3 else value
    if not isinstance(numbers, list | tuple) or len(numbers) != 3:
        raise FreeOccError(f"'{key}' of {path} must be three numbers.")
    if not all(isinstance(n, int | float | np.number) and -_FARTHEST < n < _FARTHEST for n in numbers):
        raise FreeOccError(f"'{key}' of {path} must be three finite numbers.")
    return [float(n) for n in numbers]


def _shape(package: dict[Any, Any], path: Path) -> tuple[int, int, int]:
    x, y, z = _triple(package, "scene_dim", path)
    if min(x, y, z) < 1 or not (x.is_integer() and y.is_integer() and z.is_integer()):
        raise FreeOccError(f"'scene_dim' of {path} must be three counts of voxels, got {x:g}, {y:g}, {z:g}.")
    return int(x), int(y), int(z)


def _on_grid(values: NDArray[Any], shape: tuple[int, int, int], key: str, path: Path) -> NDArray[Any]:
    """Returns the (X, Y, Z) values of an array (X, Y, Z) or (X * Y * Z,)."""
    if values.dtype.kind not in "biuf" or values.shape not in (shape, (math.prod(shape),)):
        raise FreeOccError(
            f"'{key}' of {path} must be numbers of shape {shape}, as 'scene_dim' says, got {values.dtype} "
            f"{values.shape}."
        )
    return values.reshape(shape)


def _labels(values: NDArray[Any], path: Path, key: str = "global_labels") -> NDArray[np.uint8]:
    """Returns a uint8 copy of labels of any number type."""
    if values.dtype.kind not in "iuf" or not ((values >= 0) & (values <= 255) & (values == np.rint(values))).all():
        raise FreeOccError(f"'{key}' of {path} must be whole numbers from 0 to 255.")
    return values.astype(np.uint8)


def _lattice(points: NDArray[Any], shape: tuple[int, int, int], path: Path) -> tuple[NDArray[np.float64], float]:
    """Returns the lower corner (3,) and voxel size, meters, of a grid with centers (X, Y, Z, 3) or (X * Y * Z, 3)."""
    what = f"'global_pts' of {path}"
    if points.dtype.kind != "f" or points.shape not in ((*shape, 3), (math.prod(shape), 3)):
        raise FreeOccError(f"{what} must be points {(*shape, 3)} as 'scene_dim', got {points.dtype} {points.shape}.")
    if not (np.abs(points) < _FARTHEST).all():
        raise FreeOccError(f"{what} must be finite, in meters.")
    points = points.reshape(*shape, 3)
    first = points[0, 0, 0].astype(np.float64)
    axes = [axis for axis in range(3) if shape[axis] > 1]
    if not axes:
        raise FreeOccError(f"{what} is a single point, so the voxel size is unknown.")
    steps = np.array([points[tuple(np.eye(3, dtype=int)[axis])] - first for axis in axes])
    if (steps.argmax(axis=1) != axes).any():
        raise FreeOccError(f"{what} must ascend along x, y and z, in this order.")
    # Over the whole extent, the rounding of float32 coordinates is negligible.
    extent = points[-1, -1, -1].astype(np.float64) - first
    spacings = np.array([extent[axis] / (shape[axis] - 1) for axis in axes])
    voxel_size = round(float(extent[axes].sum() / sum(shape[axis] - 1 for axis in axes)), 6)
    tolerance = 0.01 * voxel_size
    if not (voxel_size > 0 and (np.abs(spacings - voxel_size) < tolerance).all()):
        along = ", ".join(f"{'xyz'[axis]} {spacing:.4g}" for axis, spacing in zip(axes, spacings, strict=True))
        raise FreeOccError(f"{what} must be the centers of cubes, but their spacing is {along} m.")
    for axis in range(3):
        line = (first[axis] + voxel_size * np.arange(shape[axis])).reshape([-1 if a == axis else 1 for a in range(3)])
        if not np.abs(points[..., axis] - line).max() < tolerance:
            raise FreeOccError(f"{what} must be a regular grid along x, y and z.")
    return first - voxel_size / 2, voxel_size


def _class_names(package: dict[Any, Any], path: Path) -> tuple[str, ...] | None:
    """Returns the class names in a package, with a name for label 0 in front."""
    key = next((key for key in ("classes", "class_names") if key in package), None)
    if key is None:
        return None
    names = package[key].tolist() if isinstance(package[key], np.ndarray) else package[key]
    if not isinstance(names, list | tuple) or not names or not all(isinstance(name, str) for name in names):
        raise FreeOccError(f"'{key}' of {path} must be a list of class names.")
    return tuple(names) if names[0].lower() in ("free", "empty") else ("free", *names)


def _frame_names(package: dict[Any, Any], path: Path) -> list[str] | None:
    """Returns the names of the frames that EmbodiedOcc scores a scene by; None if the package does not list them."""
    paths = package.get("valid_img_paths")
    if isinstance(paths, np.ndarray):
        paths = paths.ravel().tolist()
    if not paths:
        return None
    if not isinstance(paths, list | tuple) or not all(isinstance(name, str) for name in paths):
        raise FreeOccError(f"'valid_img_paths' of {path} must be a list of paths.")
    return [PurePosixPath(name).stem for name in paths]


def _add_mask(union: NDArray[np.bool_], mask: NDArray[Any], path: Path) -> None:
    """Adds the voxels of a frame's mask to the union. mask: (X, Y, Z) or (X * Y * Z,), as in EmbodiedOcc's loader, or
    the indices of its voxels in the flattened grid."""
    if mask.shape in (union.shape, (union.size,)) and mask.dtype.kind in "biuf" and ((mask == 0) | (mask == 1)).all():
        union |= mask.reshape(union.shape).astype(bool)
    elif mask.ndim == 1 and mask.dtype.kind in "iu" and ((mask >= 0) & (mask < union.size)).all():
        union.reshape(-1)[mask] = True
    else:
        raise FreeOccError(
            f"'mask_in_global' of {path} is neither a mask of the scene's {union.shape} voxels nor their indices, got "
            f"{mask.dtype} {mask.shape}: does the file belong to this data set?"
        )


def _scene_of(entry: str, path: Path) -> str:
    """Returns the scene that an entry of a split names."""
    if match := re.search(r"(?<![A-Za-z0-9])scene\d{4}_\d{2}(?!\d)", entry):
        return match[0]
    if entry.startswith("scene") or not re.fullmatch(r"[A-Za-z]\w*(-\w+)*", entry):
        raise FreeOccError(f"The entry '{shorten(entry)}' of the split {path} names no scene, such as scene0000_00.")
    return entry
