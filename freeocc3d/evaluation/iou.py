"""Occupied voxels against the true ones, inside what the truth observed.

A finished grid is never resampled here: the map's Gaussians are projected at the truth's own voxel centres, and what
arrives is already on the truth's lattice.
"""

from __future__ import annotations

import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import FreeOccError
from ..types import FREE, UNKNOWN


@dataclass(frozen=True)
class GroundTruth:
    """True occupancy of a scene, ``ground_truth.npz``.

    labels: (X, Y, Z) uint8, 0 free, k = ``classes[k]``, 255 not observed.
    origin: (3,) float64 lower corner of voxel (0, 0, 0) in the frame of the true poses, metres.
    voxel_size: edge of a voxel, metres.  classes: names of the labels; ``classes[0]`` is not used.
    """

    labels: NDArray[np.uint8]
    origin: NDArray[np.float64]
    voxel_size: float
    classes: tuple[str, ...]

    @property
    def shape(self) -> tuple[int, int, int]:
        """Voxels along x, y and z."""
        x, y, z = self.labels.shape
        return x, y, z


@dataclass(frozen=True)
class OccupancyScore:
    """Fractions 0…1 over the voxels inside the mask; one without a denominator is 0.

    iou: both / either.  precision: both / predicted.  recall: both / true.  voxels: in the mask.
    """

    iou: float
    precision: float
    recall: float
    voxels: int


def occupancy_iou(labels_true: NDArray[np.uint8], occupied_pred: NDArray[np.bool_]) -> OccupancyScore:
    """Score a prediction where the truth is known (label != 255).

    labels_true: (X, Y, Z), 0 free, 255 not observed, else occupied.
    occupied_pred: (X, Y, Z) bool on the same lattice; a voxel that the map calls unknown is False.
    Raises FreeOccError: shapes differ, the prediction is not boolean, nothing was observed.
    """
    if occupied_pred.shape != labels_true.shape:
        raise FreeOccError(f"The prediction's lattice {occupied_pred.shape} is not the truth's {labels_true.shape}.")
    if occupied_pred.dtype != np.bool_:
        # 255, the state of unknown voxels, would be taken for occupied.
        raise FreeOccError(f"A prediction is boolean, occupied or not, but this one is {occupied_pred.dtype}.")
    mask = labels_true != UNKNOWN
    if not mask.any():
        raise FreeOccError("The ground truth observed no voxel at all, so there is nothing to score.")
    truth, pred = labels_true[mask] != FREE, occupied_pred[mask]
    both, either = int((truth & pred).sum()), int((truth | pred).sum())
    return OccupancyScore(
        iou=_fraction(both, either),
        precision=_fraction(both, int(pred.sum())),
        recall=_fraction(both, int(truth.sum())),
        voxels=len(truth),
    )


def load_ground_truth(path: str | Path) -> GroundTruth:
    """Read ``ground_truth.npz``; nothing is unpickled. Raises FreeOccError: no such file, damaged, an array is
    missing or has another shape or type than ``GroundTruth`` states, a label has no class."""
    path = Path(path)
    arrays = _read(path)
    labels = _array(arrays, "labels", path)
    origin = _array(arrays, "origin", path)
    size = _array(arrays, "voxel_size", path)
    classes = _array(arrays, "classes", path)
    if labels.dtype != np.uint8 or labels.ndim != 3:
        raise FreeOccError(f"'labels' of {path} must be uint8 (X, Y, Z), got {labels.dtype} {labels.shape}.")
    if origin.dtype.kind != "f" or origin.shape != (3,) or not np.isfinite(origin).all():
        raise FreeOccError(f"'origin' of {path} must be three finite numbers in metres.")
    if size.dtype.kind != "f" or size.shape != () or not (np.isfinite(size) and size > 0):
        raise FreeOccError(f"'voxel_size' of {path} must be one positive number in metres.")
    if classes.dtype.kind != "U" or classes.ndim != 1:
        raise FreeOccError(f"'classes' of {path} must be a list of names, got {classes.dtype} {classes.shape}.")
    largest = int(labels.max(initial=0, where=labels != UNKNOWN))
    if largest >= max(len(classes), 1):
        raise FreeOccError(f"'labels' of {path} hold class {largest}, but only {len(classes)} classes are named.")
    return GroundTruth(labels, origin.astype(np.float64), float(size), tuple(classes.tolist()))


def _read(path: Path) -> dict[str, NDArray[Any]]:
    """All arrays of an .npz file by name."""
    try:
        loaded = np.load(path, allow_pickle=False)
        if isinstance(loaded, np.lib.npyio.NpzFile):
            with loaded:
                return {name: loaded[name] for name in loaded.files}
    except OSError as error:
        raise FreeOccError(f"Cannot read the ground truth {path}: {error.strerror or error}.") from error
    except (ValueError, EOFError, zipfile.BadZipFile, zlib.error, NotImplementedError) as error:
        raise FreeOccError(f"The ground truth {path} is damaged or not an .npz file of plain arrays.") from error
    raise FreeOccError(f"The ground truth {path} holds a single array; it must be an .npz file with named ones.")


def _array(arrays: dict[str, NDArray[Any]], name: str, path: Path) -> NDArray[Any]:
    if name not in arrays:
        raise FreeOccError(f"The ground truth {path} has no '{name}'; it holds {', '.join(arrays) or 'nothing'}.")
    return arrays[name]


def _fraction(part: int, whole: int) -> float:
    return part / whole if whole else 0.0
