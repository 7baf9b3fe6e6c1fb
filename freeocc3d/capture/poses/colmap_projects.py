"""Finds the COLMAP models of a project, and the folder with the images of each.

A model lies in the folder itself, in ``sparse``, ``colmap/sparse`` (nerfstudio) or ``dense/sparse`` (undistorted
images), or there in a folder with a number. A mapper writes one for each part of the scan that it could not connect.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from ...core.regular_files import open_regular
from ...core.warnings import Notice
from ..files.numbered_files import list_folder

IMAGES = "images"
_BINARY, _TEXT = "images.bin", "images.txt"
_ROOTS = ("", "colmap", "dense", "dense/0", "colmap/dense", "colmap/dense/0", "undistorted")
_SHORTEST_RECORD = 80
_COUNTED_BYTES = 1 << 30


@dataclass(frozen=True)
class ColmapProject:
    """The model of a project with the most images. images: their folder; None if there is none.  counts: registered
    images by model, the largest first."""

    model: Path
    images: Path | None
    counts: Sequence[tuple[Path, int]]

    def notices(self) -> tuple[Notice, ...]:
        """A warning if other models are left out."""
        if len(self.counts) < 2:
            return ()
        (taken, most), *others = self.counts
        rest = ", ".join(f"{model.name} with {count}" for model, count in others[:5])
        more = f" and {len(others) - 5} more" if len(others) > 5 else ""
        return (
            Notice(
                "models-apart",
                f"{taken.parent} holds {len(self.counts)} models: {taken.name} with {most} images is taken; "
                f"{rest}{more} {'is' if len(others) == 1 else 'are'} left out, because nothing says how they lie "
                "relative to it.",
            ),
        )


def find_colmap_project(folder: Path) -> ColmapProject | None:
    """The first place below ``folder`` that has models, with images if there is one; None without any model.

    Raises CaptureError if a folder cannot be listed.
    """
    found = None
    for root in _ROOTS:
        models = _models_at(folder / root)
        if not models:
            continue
        counts = [(model, count_images(model) if len(models) > 1 else 0) for model in models]
        counts.sort(key=lambda one: -one[1])
        places = [folder / root / IMAGES] + ([folder / IMAGES] if root == "colmap" else [])
        images = next((place for place in places if place.is_dir()), None)
        project = ColmapProject(counts[0][0], images, counts)
        if images is not None:
            return project
        found = found or project
    return found


def colmap_folder(folder: Path) -> Path | None:
    """The folder of the model that ``find_colmap_project`` finds, or None."""
    project = find_colmap_project(folder)
    return None if project is None else project.model


def count_images(model: Path) -> int:
    """How many images a model states; 0 for one that cannot be read or states more than it can hold."""
    try:
        if (model / _BINARY).is_file():
            with open_regular(model / _BINARY) as stream:
                count = int.from_bytes(stream.read(8), "little")
            return count if count * _SHORTEST_RECORD <= (model / _BINARY).stat().st_size else 0
        with open_regular(model / _TEXT, _COUNTED_BYTES) as stream:
            lines = sum(not line.startswith(b"#") for line in stream)
        return (lines + 1) // 2
    except OSError:
        return 0


def _models_at(root: Path) -> list[Path]:
    """The models in the folder or its ``sparse``; those in numbered folders, if any."""
    for place in (root, root / "sparse"):
        if _is_model(place):
            return [place]
    for place in (root / "sparse", root):
        numbers = sorted((name for name in list_folder(place) if name.isdecimal()), key=int)
        if models := [place / name for name in numbers if _is_model(place / name)]:
            return models
    return []


def _is_model(folder: Path) -> bool:
    return any(os.path.isfile(folder / name) for name in (_BINARY, _TEXT))
