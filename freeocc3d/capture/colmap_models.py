"""Finds and reads COLMAP models (cameras, images, points3D, as .bin or .txt) and their lenses."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..core.errors import CaptureError
from ..core.types import Intrinsics
from .lenses import Lens, lens_of

if TYPE_CHECKING:
    import pycolmap


def colmap_folder(folder: Path) -> Path | None:
    """The folder of the COLMAP model: ``folder`` itself, ``sparse/0``, ``sparse`` or ``0``; None if there is none."""
    models = (folder, folder / "sparse" / "0", folder / "sparse", folder / "0")
    return next((m for m in models if any((m / name).is_file() for name in ("images.bin", "images.txt"))), None)


def read_colmap_model(folder: Path) -> pycolmap.Reconstruction:
    """Read the model in a folder. Raises CaptureError."""
    import pycolmap

    model = pycolmap.Reconstruction()
    try:
        if (folder / "images.bin").is_file():
            model.read_binary(str(folder))
        else:
            model.read_text(str(folder))
    except (RuntimeError, ValueError, IndexError, MemoryError, OSError) as error:
        said = " ".join(str(error).split())[:160].rstrip(".")
        raise CaptureError(
            f"{folder} holds no readable COLMAP model: it needs complete cameras, images and points3D, all .txt or "
            f"all .bin ({said})."
        ) from error
    return model


def colmap_lens(camera: pycolmap.Camera, source: str) -> Lens:
    """The lens of a model's camera. COLMAP's pixel coordinates start at the corner of the first pixel, ours at its
    center. source: where the model comes from, for messages. Raises CaptureError for an unsupported camera model."""
    names = [name.strip() for name in camera.params_info.split(",")]
    values = dict(zip(names, np.asarray(camera.params, np.float64).tolist(), strict=True))
    fx = values.pop("fx", values.pop("f", 0.0))
    fy = values.pop("fy", fx)
    intrinsics = Intrinsics(camera.width, camera.height, fx, fy, values.pop("cx") - 0.5, values.pop("cy") - 0.5)
    return lens_of(camera.model.name, intrinsics, values, source)
