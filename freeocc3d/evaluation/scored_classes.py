"""The scored classes, and the names of other taxonomies that map to them.

A class file (``capture/class_files.py``) works in both directions. It turns the truth's names into the scored classes.
It also gives the names to ask a map for: each voxel takes the class that its best name maps to.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ..capture.class_files import read_class_file
from ..core.errors import FreeOccError
from ..core.types import UNKNOWN
from .true_occupancy import GroundTruth

EMBODIEDOCC = (
    "ceiling", "floor", "wall", "window", "chair", "bed", "sofa", "table", "tvs", "furniture", "objects",
)  # fmt: skip
"""The 11 classes of Occ-ScanNet and EmbodiedOcc-ScanNet, labels 1 … 11."""

SHARED = EMBODIEDOCC[:8]
"""The 8 of them that ReplicaOcc shares (paper, Sec. "Datasets and Metrics")."""

FREE = "free"
"""Name of label 0."""

_MOST_CLASSES = 254


@dataclass(frozen=True)
class ClassMap:
    """A map from names to scored classes.

    classes: names of the scored classes; label k is ``classes[k - 1]``.
    labels: label of every known name in lower case, 0 for a name that is not scored.
    """

    classes: tuple[str, ...]
    labels: dict[str, int]

    @property
    def words(self) -> tuple[str, ...]:
        """Every name that stands for a scored class: the words to ask a map for."""
        return tuple(name for name, label in self.labels.items() if label)

    def apply(self, truth: GroundTruth, source: str) -> GroundTruth:
        """Returns the truth with the scored classes. Voxels of other classes become 255.

        source: the class file's name, for messages. Raises FreeOccError: the truth holds an unknown class.
        """
        table = np.full(256, UNKNOWN, np.uint8)
        table[0] = 0
        occurring = np.unique(truth.labels[(truth.labels != 0) & (truth.labels != UNKNOWN)])
        unknown = [truth.classes[k] for k in occurring if truth.classes[k].lower() not in self.labels]
        if unknown:
            raise FreeOccError(
                f"{source} does not name {', '.join(repr(name) for name in unknown)}, which the ground truth holds: "
                "add each to its 'map', with one of its classes or null."
            )
        for k in occurring:
            table[k] = self.labels[truth.classes[k].lower()] or UNKNOWN
        return replace(truth, labels=table[truth.labels], classes=(truth.classes[0], *self.classes))


def map_each_to_itself(classes: tuple[str, ...]) -> ClassMap:
    """Maps every class to itself. classes: as in ``GroundTruth``; the first is not used."""
    return ClassMap(classes[1:], {name.lower(): k for k, name in enumerate(classes) if k})


def load_class_map(path: Path) -> ClassMap:
    """Reads a class file. Raises FreeOccError: no such file, another form, a target that is not a class."""
    listed = read_class_file(path)
    labels = {name.lower(): label for label, name in enumerate(listed.names, start=1)}
    if len(labels) < len(listed.names) or len(listed.names) > _MOST_CLASSES:
        raise FreeOccError(f"'classes' of {path} must be at most {_MOST_CLASSES} different names.")
    known = {name: 0 if target is None else labels[target.lower()] for name, target in listed.targets.items()}
    return ClassMap(listed.names, labels | known)
