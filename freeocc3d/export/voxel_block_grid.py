"""Open3D's VoxelBlockGrid, for `open3d.t.geometry.VoxelBlockGrid.load`, with evidence, colors and features.

Blocks of 8 x 8 x 8 voxels have these attributes for each voxel, with zeros for all other voxels:
    probability (1) float32: alpha of the voxel's center; state (1) uint8: 0 free, 1 occupied, 255 unknown
    free, hits (1) uint16: number of depth images that saw through the voxel, and that ended in it
    color (3) uint8 RGB, and feature (R) float32, the unit language feature: for occupied voxels
The file also holds arrays that Open3D ignores and `numpy.load` reads:
    origin (3,) lower corner of voxel (0, 0, 0), meters; T_world_map (4, 4) from the grid's frame to the map's world
    feature_basis (R, D): the cosine of a feature and a word's unit feature t (D,) is feature @ (feature_basis @ t)
    words: names of the map's vocabulary as UTF-8 bytes, one a line; word_features (W, R): their features in the basis,
    so that cosines are feature @ word_features.T; word_attainable (W,): a score is a cosine over this
Features of other words: `freeocc3d.load_map(MAP).text_encoder.encode_words([word]).features`. NAME.npz.json next to the
file holds the frame, the encoder, and the least score of a match.
Open3D places values at `index * voxel_size`; add `origin + voxel_size / 2` to get the centers of voxels. Its blocks
hold their values in the order z, y, x. A map of several voxel sizes is sampled at the largest size.
"""

from __future__ import annotations

import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..core.errors import ExportError, FreeOccError
from ..core.types import BLOCK, OCCUPIED, Occupancy
from ..core.voxel_keys import pack_voxels
from ..language.feature_codec import CodedFeatures, Features
from ..query.scan_map import Map
from .export_frames import Frame, VoxelOptions, find_world, place_voxels, write_description

if TYPE_CHECKING:
    import open3d as o3d

REQUIRES: tuple[str, ...] = ()
ENDINGS = (".npz",)

_PER_VOXEL = {"probability": np.float32, "free": np.uint16, "hits": np.uint16, "state": np.uint8}
_OF_OCCUPIED = {"color": np.uint8, "feature": np.float32}
_BLOCKS_AT_ONCE = 64
_LARGEST_ATTRIBUTE = (1 << 31) - 1
"""Largest attribute, bytes: Open3D does not read 64-bit ZIP archives."""

_Read = Callable[[slice], NDArray[Any]]
"""Returns the values (n, 512, channels) of a slice of n blocks."""


class Options(VoxelOptions, frozen=True):
    """Frame and features."""

    frame: Frame = "map"
    features: bool = True
    """Write the language features and the words of the map's vocabulary."""


def write(scan_map: Map, path: Path, options: Options) -> None:
    """Writes the grid. Raises ExportError if nothing is known, or if
    features take more than 2 GiB."""
    there = place_voxels(scan_map, options.frame, one_size=True, box=options.box)
    described, beside = there.described(), {"T_world_map": find_world(scan_map, there.T_frame_map)}
    features: Features | None = None
    if options.features and scan_map.occupancy.features.shape[1]:
        features = scan_map.occupancy.features[there.rows]
        beside |= _vocabulary(scan_map, _basis(features))
        encoder = scan_map.text_encoder
        described |= {"encoder": scan_map.manifest.encoder.name, "threshold": encoder.threshold}
    write_grid(path, there.occupancy, features, beside)
    write_description(path, described)


def _basis(features: Features) -> NDArray[np.float32]:
    """Returns the (R, D) orthonormal basis of the features."""
    if isinstance(features, CodedFeatures):
        return features.codec.basis
    return np.eye(features.shape[1], dtype=np.float32)


def _vocabulary(scan_map: Map, basis: NDArray[np.float32]) -> dict[str, NDArray[Any]]:
    """Returns the arrays of the map's words in the features' basis."""
    words = scan_map.vocabulary
    text = scan_map.text_encoder.encode_words(words)
    attainable = np.ones(len(words)) if text.attainable is None else text.attainable
    return {
        "words": np.frombuffer("\n".join(words).encode("utf-8"), np.uint8),
        "word_features": np.asarray(text.features @ basis.T, np.float32).reshape(len(words), len(basis)),
        "word_attainable": np.asarray(attainable, np.float32),
    }


def write_grid(
    path: Path,
    occupancy: Occupancy,
    features: Features | None = None,
    beside: Mapping[str, NDArray[Any]] | None = None,
) -> None:
    """Writes the file block by block, so that all features are never decoded at once.

    occupancy: of one voxel size.  features: (V, D) of its occupied voxels, coded or not; None leaves "feature" out.
    beside: more arrays for the file, of number types that Open3D knows. Raises ExportError, OSError.
    """
    if occupancy.deepest:
        raise ExportError("A VoxelBlockGrid holds voxels of one size: call levels.make_uniform first.")
    attributes = _attributes(occupancy, features)
    arrays: dict[str, NDArray[Any]] = {
        "key": occupancy.keys,
        "CPU:0": np.zeros((), np.uint8),
        "block_resolution": np.array([BLOCK], np.int64),
        "voxel_size": np.array([occupancy.voxel_size], np.float32),
        "origin": occupancy.origin,
        **({} if features is None else {"feature_basis": _basis(features)}),
        **(beside or {}),
    }
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=4) as archive:
        for number, (name, (channels, read)) in enumerate(attributes.items()):
            kind = np.dtype((_PER_VOXEL | _OF_OCCUPIED)[name])
            shape = (len(occupancy.keys), BLOCK, BLOCK, BLOCK, channels)
            _refuse_too_large(name, shape, kind)
            arrays[f"attr_name_{name}"] = np.array([number], np.int32)
            with archive.open(f"value_{number:03d}.npy", "w") as stream:
                header = {"descr": np.lib.format.dtype_to_descr(kind), "fortran_order": False, "shape": shape}
                np.lib.format.write_array_header_1_0(stream, header)
                _write_values(stream, read, shape, kind)
        for name, array in arrays.items():
            with archive.open(f"{name}.npy", "w") as stream:
                np.lib.format.write_array(stream, np.asarray(array, order="C"), allow_pickle=False)


def _refuse_too_large(name: str, shape: tuple[int, ...], kind: np.dtype[Any]) -> None:
    if np.prod([float(n) for n in shape]) * kind.itemsize > _LARGEST_ATTRIBUTE:
        raise ExportError(
            f"The attribute '{name}' takes more than 2 GiB, which Open3D does not read: export a part of the "
            "map with --set box=…, or leave features out with --set features=false."
        )


def _write_values(stream: IO[bytes], read: _Read, shape: tuple[int, int, int, int, int], kind: np.dtype[Any]) -> None:
    for start in range(0, shape[0], _BLOCKS_AT_ONCE):
        values = read(slice(start, min(start + _BLOCKS_AT_ONCE, shape[0])))
        blocks = values.reshape(-1, *shape[1:]).transpose(0, 3, 2, 1, 4)  # from x, y, z to z, y, x
        stream.write(np.ascontiguousarray(blocks, kind).tobytes())


def _attributes(occupancy: Occupancy, features: Features | None) -> dict[str, tuple[int, _Read]]:
    """Returns, by name, the number of channels and the function that reads the values of some blocks."""
    occupied = occupancy.state == OCCUPIED
    first = np.concatenate(([0], np.cumsum(np.count_nonzero(occupied, axis=1))))

    def spread(blocks: slice, values: Callable[[slice], NDArray[Any]], channels: int) -> NDArray[Any]:
        """Puts the rows of occupied voxels at their places, with zeros elsewhere."""
        out = np.zeros((blocks.stop - blocks.start, BLOCK**3, channels), np.float32)
        out[occupied[blocks]] = values(slice(int(first[blocks.start]), int(first[blocks.stop])))
        return out

    def per_voxel(name: str) -> _Read:
        return lambda blocks: getattr(occupancy, name)[blocks, :, None]

    attributes: dict[str, tuple[int, _Read]] = {name: (1, per_voxel(name)) for name in _PER_VOXEL}
    attributes["color"] = 3, lambda blocks: spread(blocks, lambda rows: occupancy.colors[rows], 3)
    if features is not None:
        basis = _basis(features)

        def coordinates(rows: slice) -> NDArray[np.float32]:
            values = np.asarray(features[rows], np.float32) @ basis.T
            length = np.linalg.norm(values, axis=1, keepdims=True)
            return np.asarray(values / np.where(length > 0, length, 1), np.float32)

        attributes["feature"] = len(basis), lambda blocks: spread(blocks, coordinates, len(basis))
    return attributes


def read_occupancy(
    grid: o3d.t.geometry.VoxelBlockGrid, voxel_size: float, origin: NDArray[np.float64] | None = None
) -> Occupancy:
    """Returns the occupancy of a grid, which needs at least "probability" and "state". Blocks are sorted by their keys.

    Blocks of 16, 24, … voxels an edge are cut into blocks of 8. voxel_size, origin: Open3D does not keep them; origin
    is the lower corner of voxel (0, 0, 0), by default the world's origin. Raises FreeOccError for other attributes.
    """
    keys, arrays, places = _read_attributes(grid)
    if not {"probability", "state"} <= arrays.keys():
        raise FreeOccError("The VoxelBlockGrid has no attributes 'probability' and 'state', so it holds no occupancy.")
    edge = round(len(places) ** (1 / 3))
    keys = (keys[:, None] * edge + places[None]).reshape(-1, 3)
    order = np.argsort(pack_voxels(keys))
    per_voxel = {
        name: arrays[name][order, :, 0].astype(kind) if name in arrays else np.zeros((len(keys), BLOCK**3), kind)
        for name, kind in _PER_VOXEL.items()
    }
    occupied = per_voxel["state"] == OCCUPIED
    count = int(np.count_nonzero(occupied))
    colors = arrays["color"][order][occupied] if "color" in arrays else np.zeros((count, 3))
    features = arrays["feature"][order][occupied] if "feature" in arrays else np.zeros((count, 0))
    return Occupancy(
        voxel_size=voxel_size,
        origin=np.zeros(3) if origin is None else np.asarray(origin, np.float64),
        keys=keys[order].astype(np.int32),
        colors=colors.astype(np.uint8),
        features=features.astype(np.float16),
        **per_voxel,
    )


def _read_attributes(
    grid: o3d.t.geometry.VoxelBlockGrid,
) -> tuple[NDArray[np.int64], dict[str, NDArray[np.generic]], NDArray[np.int64]]:
    """Returns the (B, 3) indices of a grid's blocks, its known attributes cut into blocks of 8, and their places."""
    import open3d as o3d
    import open3d.core as o3c

    rows = grid.hashmap().active_buf_indices().to(o3c.int64)
    keys = grid.hashmap().key_tensor()[rows].cpu().numpy().astype(np.int64)
    arrays, places = {}, np.zeros((1, 3), np.int64)
    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        for name in (*_PER_VOXEL, *_OF_OCCUPIED):
            try:
                values = grid.attribute(name)[rows].cpu().numpy()
            except RuntimeError:  # a missing attribute: Open3D returns an undefined tensor, which raises on every use
                continue
            arrays[name], places = _cut(values)
    return keys, arrays, places


def _cut(values: NDArray[np.generic]) -> tuple[NDArray[np.generic], NDArray[np.int64]]:
    """Returns Open3D's blocks (B, R, R, R, C) as blocks of 8, (B (R / 8)^3, 512, C), and the place of each of the
    (R / 8)^3 blocks within its block. Raises FreeOccError if 8 does not divide R."""
    resolution, channels = values.shape[1], values.shape[4]
    parts = resolution // BLOCK
    if parts * BLOCK != resolution:
        raise FreeOccError(
            f"The VoxelBlockGrid has blocks of {resolution} voxels an edge, but only 8, 16, 24, … can be read."
        )
    cut = values.reshape(-1, parts, BLOCK, parts, BLOCK, parts, BLOCK, channels)
    ours = cut.transpose(0, 5, 3, 1, 6, 4, 2, 7).reshape(-1, BLOCK**3, channels)
    return ours, np.stack(np.unravel_index(np.arange(parts**3), (parts,) * 3), axis=1)
