"""Computes occupancy and class scores on a truth's lattice from one confusion matrix.

The sum of the scenes' matrices pools them, as in EmbodiedOcc's evaluation (Y. Wu et al., EmbodiedOcc, ICCV 2025). IoU
is binary, occupied or not. The IoU of a class is tp / (tp + fp + fn) over all voxels of all scenes. mIoU is the mean
over a list of classes; a class that never occurs counts 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..core.errors import FreeOccError
from ..core.types import FREE


@dataclass(frozen=True)
class Prediction:
    """A claim about the voxels of a truth's lattice. Unknown voxels are not occupied.

    occupied: (X, Y, Z) bool.
    labels: (X, Y, Z) uint8, k = class k of the truth for an occupied voxel of known class, else 0; None if the method
        knows no classes.
    """

    occupied: NDArray[np.bool_]
    labels: NDArray[np.uint8] | None = None


def count_confusion(
    labels_true: NDArray[np.uint8], predicted: Prediction, mask: NDArray[np.bool_], classes: int
) -> NDArray[np.int64]:
    """Counts the (C + 1, C + 2) voxels inside the mask by truth (rows: free, class 1 … C) and prediction (columns: not
    occupied, class 1 … C, occupied by an unknown class).

    labels_true: (X, Y, Z), 0 free, k class k.  mask: (X, Y, Z) bool, only voxels whose truth is known.  classes: C.
    Raises FreeOccError: shapes differ, the prediction is not boolean, the mask is empty.
    """
    occupied = predicted.occupied
    if occupied.shape != labels_true.shape:
        raise FreeOccError(f"The prediction's lattice {occupied.shape} is not the truth's {labels_true.shape}.")
    if occupied.dtype != np.bool_:
        # A number would count unknown voxels, 255, as occupied.
        raise FreeOccError(f"A prediction must be boolean, occupied or not, but this one is {occupied.dtype}.")
    if not mask.any():
        raise FreeOccError("The ground truth observed no voxels, so there is nothing to score.")
    row = labels_true[mask].astype(np.int64)
    label = np.zeros(len(row), np.int64) if predicted.labels is None else predicted.labels[mask].astype(np.int64)
    if max(row.max(), label.max()) > classes:
        raise FreeOccError(f"A label is {max(row.max(), label.max())}, but only {classes} classes have names.")
    column = np.where(occupied[mask], np.where(label > 0, label, classes + 1), FREE)
    counts = np.bincount(row * (classes + 2) + column, minlength=(classes + 1) * (classes + 2))
    return counts.reshape(classes + 1, classes + 2)


@dataclass(frozen=True)
class Scores:
    """Fractions 0…1 from a pooled confusion matrix; a fraction without a denominator is 0.

    matrix: (C + 1, C + 2), see ``count_confusion``.  classes: names of class 1 … C.
    """

    matrix: NDArray[np.int64]
    classes: tuple[str, ...]

    @property
    def voxels(self) -> int:
        """Voxels inside the mask."""
        return int(self.matrix.sum())

    @property
    def _both(self) -> int:
        return int(self.matrix[1:, 1:].sum())

    @property
    def iou(self) -> float:
        """Voxels occupied in both / voxels occupied in either."""
        return _fraction(self._both, int(self.matrix.sum() - self.matrix[0, 0]))

    @property
    def precision(self) -> float:
        """Voxels occupied in both / voxels predicted as occupied."""
        return _fraction(self._both, int(self.matrix[:, 1:].sum()))

    @property
    def recall(self) -> float:
        """Voxels occupied in both / truly occupied voxels."""
        return _fraction(self._both, int(self.matrix[1:].sum()))

    @property
    def class_voxels(self) -> NDArray[np.int64]:
        """(C,) number of true voxels of each class."""
        return self.matrix[1:].sum(axis=1)

    @property
    def class_iou(self) -> NDArray[np.float64]:
        """(C,) IoU of each class; 0 for a class that occurs in neither."""
        C = len(self.classes)
        hit = np.diagonal(self.matrix[1:, 1 : C + 1]).astype(np.float64)
        either = self.class_voxels + self.matrix[:, 1 : C + 1].sum(axis=0) - hit
        return hit / np.maximum(either, 1)

    @property
    def present(self) -> tuple[str, ...]:
        """Classes that the truth holds."""
        return tuple(name for name, count in zip(self.classes, self.class_voxels, strict=True) if count)

    def most_frequent(self, count: int) -> tuple[str, ...]:
        """Returns the ``count`` classes with most true voxels, most frequent first; fewer if the truth holds fewer."""
        order = np.argsort(-self.class_voxels, kind="stable")
        return tuple(self.classes[k] for k in order[:count] if self.class_voxels[k])

    def miou(self, names: Sequence[str]) -> float:
        """Returns the mean IoU over some classes; a class that does not occur counts 0."""
        rows = [self.classes.index(name) for name in names]
        return float(self.class_iou[rows].mean()) if rows else 0.0


def _fraction(part: int, whole: int) -> float:
    return part / whole if whole else 0.0
