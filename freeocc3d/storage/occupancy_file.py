"""occupancy.npz and features.npz: the sparse voxel blocks with coded features, and the tables of the codec."""

from __future__ import annotations

from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from ..core.arrays import Shape, read_arrays, write_arrays
from ..core.errors import MapError
from ..core.types import BLOCK, OCCUPIED, UNKNOWN, Occupancy
from ..core.voxel_keys import KEY_LIMIT, pack_index, pack_voxels
from ..language.feature_codec import MOST_BYTES, Codec, CodedFeatures
from .manifest import Manifest
from .map_files import FEATURES, MANIFEST, OCCUPANCY

_DEEPEST = 12
"""Level of the smallest voxels of any map: from 4 m down to a millimeter."""
_MARGIN = 8
"""Blocks next to the farthest ones that may be asked for."""
_SAME_SIZE = 1e-6
_CORNER = pack_index(*[-KEY_LIMIT // BLOCK] * 3)
"""The key of the lowest block; without it, the key of a block has at most 60 bits."""
_ONE_HALF = 0x3C00  # the bits of 1 in half precision; negative numbers, infinity and NaN have larger ones
_MOST_BYTES, _CODEC_BYTES, _FILE_BYTES, _VOXEL_BYTES = 8 << 30, 64 << 20, 1 << 20, 128
_CODEC_ARRAYS = {
    "codec_basis": ("f", 2), "codec_bits": ("u", 1), "codec_offset": ("f", 1),
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


def read_codec(path: Path) -> Codec:
    """Read the tables of the codec from features.npz. A query needs no more of the file. Raises MapError."""
    arrays = read_arrays(path, _CODEC_ARRAYS, most_bytes=_CODEC_BYTES)
    try:
        return Codec.from_tables({name.removeprefix("codec_"): table for name, table in arrays.items()})
    except ValueError as error:
        raise MapError(f"{path} is damaged: {error}.") from error


def read_gaussian_codes(path: Path, manifest: Manifest, codec: Codec) -> NDArray[np.uint8]:
    """Read the (N, M) coded features of the Gaussians from features.npz. Raises MapError."""
    count = manifest.counts.gaussians
    expected = {"gaussian_codes": ("u", (count, None))}
    codes = read_arrays(path, expected, most_bytes=count * MOST_BYTES)["gaussian_codes"]
    if codes.shape[1] != codec.code_bytes or codes.dtype != np.uint8:
        raise MapError(f"{path} is damaged: its feature codes do not match its codec.")
    return codes


def read_occupancy(path: Path, manifest: Manifest, codec: Codec) -> Occupancy:
    """Read the voxels from occupancy.npz. Their features stay coded. Raises MapError."""
    arrays = read_arrays(path, _expected(path, manifest, codec), ("levels",), most_bytes=_MOST_BYTES)
    arrays.setdefault("levels", np.zeros(len(arrays["keys"]), np.uint8))
    if problem := _problem(arrays, manifest):
        raise MapError(f"{path} is damaged: {problem}.")
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


def _expected(path: Path, manifest: Manifest, codec: Codec) -> dict[str, tuple[str, Shape]]:
    """Kind and shape of each array of occupancy.npz, as the manifest's counts and the codec make them."""
    counts = manifest.counts.voxels
    every = counts.occupied + counts.free + counts.unknown
    if counts.unknown:
        blocks = every // BLOCK**3
    else:  # as in maps of earlier versions; hardly a block is unknown throughout
        blocks = len(
            read_arrays(path, {"keys": ("i", (None, 3))}, most_bytes=_FILE_BYTES + _VOXEL_BYTES * every)["keys"]
        )
    voxels = (blocks, BLOCK**3)
    return {
        "keys": ("i", (blocks, 3)), "probability": ("f", voxels), "free": ("u", voxels), "hits": ("u", voxels),
        "state": ("u", voxels), "colors": ("u", (counts.occupied, 3)),
        "feature_codes": ("u", (counts.occupied, codec.code_bytes)), "levels": ("u", (blocks,)),
    }  # fmt: skip


def _problem(arrays: dict[str, NDArray[Any]], manifest: Manifest) -> str:
    """The problem of arrays whose kinds and shapes are right; empty if they have none."""
    keys, levels, state, probability = (arrays[name] for name in ("keys", "levels", "state", "probability"))
    if levels.shape != (len(keys),) or levels.dtype != np.uint8 or levels.max(initial=0) > _DEEPEST:
        return "its array 'levels' holds no levels of its blocks"
    deepest = int(levels.max(initial=0))
    if abs(manifest.finest_m * 2**deepest / manifest.voxel_size_m - 1) > _SAME_SIZE:
        return f"its levels do not make the smallest voxels that {MANIFEST} states"
    least = KEY_LIMIT // BLOCK - _MARGIN >> (deepest - levels.astype(np.int64))
    if ((keys < -least[:, None]) | (keys >= least[:, None])).any():
        return "its array 'keys' holds blocks too far from the origin"
    if len(np.unique(pack_voxels(keys) - _CORNER | levels.astype(np.int64) << 60)) < len(keys):
        return "its array 'keys' holds a block twice"
    counts = manifest.counts.voxels
    occupied, free = int(np.count_nonzero(state == OCCUPIED)), state.size - int(np.count_nonzero(state))
    unknown = int(np.count_nonzero(state == UNKNOWN))
    if occupied + free + unknown < state.size or (occupied, free) != (counts.occupied, counts.free):
        return f"its array 'state' does not hold the voxels that {MANIFEST} counts"
    if not _within_one(probability):
        return "its array 'probability' holds numbers outside 0 to 1"
    narrow = {"state": np.uint8, "colors": np.uint8, "feature_codes": np.uint8, "free": np.uint16, "hits": np.uint16}
    wide = next((name for name, kind in narrow.items() if arrays[name].dtype.itemsize > np.dtype(kind).itemsize), None)
    return f"its array '{wide}' holds wider numbers than maps have" if wide else ""


def _within_one(values: NDArray[np.floating]) -> bool:
    """Whether all numbers are from 0 to 1. Of half precision, most are seen by their bits, which are much faster to
    compare."""
    if values.dtype == np.float16 and values.size and values.view(np.uint16).max() <= _ONE_HALF:
        return True
    return bool(((values >= 0) & (values <= 1)).all())
