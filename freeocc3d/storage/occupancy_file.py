"""occupancy.npz and features.npz: the sparse voxel blocks with coded features, and the tables of the codec."""

from __future__ import annotations

from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from ..core.arrays import read_arrays, write_arrays
from ..core.errors import MapError
from ..core.types import BLOCK, OCCUPIED, Occupancy
from ..language.feature_codec import Codec, CodedFeatures
from .manifest import Manifest
from .map_files import FEATURES, OCCUPANCY

_DEEPEST = 12
"""Level of the smallest voxels of any map: from 4 m down to a millimeter."""
_OCCUPANCY_ARRAYS = {
    "keys": ("i", 2), "probability": ("f", 2), "free": ("u", 2), "hits": ("u", 2), "state": ("u", 2),
    "colors": ("u", 2), "feature_codes": ("u", 2),
}  # fmt: skip
"""Arrays of occupancy.npz: kind of number and number of dimensions."""
_FEATURE_ARRAYS = {
    "gaussian_codes": ("u", 2), "codec_basis": ("f", 2), "codec_bits": ("u", 1), "codec_offset": ("f", 1),
    "codec_scale": ("f", 1),
}  # fmt: skip


def write_occupancy(folder: Path, occupancy: Occupancy, codec: Codec) -> None:
    """Write occupancy.npz. Raises OSError."""
    levels = {"levels": occupancy.levels} if occupancy.deepest else {}
    arrays = {
        "keys": occupancy.keys,
        "probability": occupancy.probability.astype(np.float16),
        "free": occupancy.free,
        "hits": occupancy.hits,
        "state": occupancy.state,
        "colors": occupancy.colors,
        "feature_codes": codec.encode(occupancy.features),
    }
    write_arrays(folder / OCCUPANCY, {**arrays, **levels}, compressed=True)


def write_features(folder: Path, codec: Codec, gaussian_features: NDArray[np.float16]) -> None:
    """Write features.npz. Raises OSError."""
    tables = {f"codec_{name}": table for name, table in codec.tables().items()}
    write_arrays(folder / FEATURES, {"gaussian_codes": codec.encode(gaussian_features), **tables}, compressed=True)


def read_features(folder: Path) -> tuple[Codec, NDArray[np.uint8]]:
    """Read the codec and the (N, M) coded features of the Gaussians. Raises MapError."""
    path = folder / FEATURES
    arrays = read_arrays(path, _FEATURE_ARRAYS)
    tables = {name.removeprefix("codec_"): table for name, table in arrays.items() if name.startswith("codec_")}
    try:
        codec = Codec.from_tables(tables)
    except ValueError as error:
        raise MapError(f"{path} is damaged: {error}.") from error
    if arrays["gaussian_codes"].shape[1] != codec.code_bytes:
        raise MapError(f"{path} is damaged: its feature codes do not match its codec.")
    return codec, arrays["gaussian_codes"]


def read_occupancy(folder: Path, manifest: Manifest, codec: Codec) -> Occupancy:
    """Read the voxels. Their features stay coded. Raises MapError."""
    path = folder / OCCUPANCY
    arrays = read_arrays(path, _OCCUPANCY_ARRAYS)
    blocks = len(arrays["keys"])
    arrays.setdefault("levels", np.zeros(blocks, np.uint8))
    if not _fit(arrays, blocks, codec):
        raise MapError(f"{path} is damaged: the sizes of its arrays do not match.")
    return Occupancy(
        voxel_size=manifest.voxel_size_m,
        origin=np.array(manifest.origin, np.float64),
        keys=arrays["keys"].astype(np.int32),
        probability=arrays["probability"].astype(np.float32),
        free=arrays["free"].astype(np.uint16),
        hits=arrays["hits"].astype(np.uint16),
        state=arrays["state"].astype(np.uint8),
        features=cast(Any, CodedFeatures(codec, arrays["feature_codes"])),
        colors=arrays["colors"].astype(np.uint8),
        levels=arrays["levels"],
    )


def _fit(arrays: dict[str, NDArray[Any]], blocks: int, codec: Codec) -> bool:
    """Whether the sizes of the arrays of occupancy.npz match each other and the codec."""
    occupied = int(np.count_nonzero(arrays["state"] == OCCUPIED))
    levels = arrays["levels"]
    return (
        arrays["keys"].shape == (blocks, 3)
        and all(arrays[name].shape == (blocks, BLOCK**3) for name in ("probability", "free", "hits", "state"))
        and arrays["colors"].shape == (occupied, 3)
        and arrays["feature_codes"].shape == (occupied, codec.code_bytes)
        and levels.shape == (blocks,)
        and levels.dtype == np.uint8
        and bool(levels.max(initial=0) <= _DEEPEST)
    )
