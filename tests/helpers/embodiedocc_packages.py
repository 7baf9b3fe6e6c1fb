"""EmbodiedOcc packages of a small grid."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from freeocc3d.core.errors import FreeOccError

SHAPE = (3, 4, 2)
CORNER = np.array([-1.04, 2.0, 0.16])


def centers(shape: tuple[int, int, int] = SHAPE, voxel: float = 0.08) -> np.ndarray:
    return CORNER + (np.moveaxis(np.indices(shape), 0, -1) + 0.5) * voxel


def package(**changes: Any) -> dict[str, Any]:
    """What a global package holds, some of it replaced; a value of None is left out."""
    labels = (np.arange(24).reshape(SHAPE) % 12).astype(np.int64)
    labels[0, 0, 0] = 255
    whole = {
        "scene_dim": np.array(SHAPE), "global_labels": labels, "global_pts": centers(),
        "global_mask": np.ones(SHAPE, bool), "valid_img_paths": ["/data1/posed_images/scene0000_00/00007.jpg"],
    } | changes  # fmt: skip
    return {key: value for key, value in whole.items() if value is not None}


def write_package(path: Path, content: object, protocol: int = 4) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(pickle.dumps(content, protocol))
    return path


def one_sentence(error: pytest.ExceptionInfo[FreeOccError]) -> bool:
    text = str(error.value)
    return text.isprintable() and text.endswith((".", "?")) and len(text) < 400
