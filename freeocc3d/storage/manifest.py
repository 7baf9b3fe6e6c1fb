"""The manifest of a map, map.yaml: every key with its type, its default and the format version that introduced it.

A map states the newest version among the keys that it uses, so an earlier freeocc3d reads every map whose keys it
knows.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, NamedTuple, get_type_hints

import msgspec
import numpy as np
from numpy.typing import NDArray

from ..core.checksums import hash_bytes
from ..core.errors import MapError
from ..core.regular_files import read_bytes
from ..core.transforms import is_rigid
from ..core.typed_documents import InvalidDocument, as_type
from ..core.yaml_documents import dump_yaml, parse_yaml
from .map_files import MANIFEST

FORMAT_VERSION = 3
"""The newest format version."""

OLDEST_VERSION = 2
"""The oldest format that is read. Format 1 packed features in another way."""

_MOST_BYTES = 64 << 20
_VOXELS, _FACTORS, _FARTHEST = (1e-6, 1e6), (1e-9, 1e9), 1e9
"""Bounds of an edge, of the meters per unit, and of coordinates: beyond what any sensor measures, and far from where
numbers lose their meaning."""
_LEVELS, _ALMOST, _UNIT = 13, 1e-6, 1e-3
_FILE = re.compile(r"(?:keyframes/)?(?!\.\.?$)[^/\\\0-\x1f]{1,200}")

POSES = "camera to world"
CODEC = "transform coding, 8, 4 and 2 bits a direction"


def _key(description: str, since: int = OLDEST_VERSION, **bounds: Any) -> msgspec.Meta:
    return msgspec.Meta(description=description, extra={"since": since}, **bounds)


Vector = tuple[float, float, float]
Row = tuple[float, float, float, float]
Matrix = tuple[Row, Row, Row, Row]
Count = Annotated[int, msgspec.Meta(ge=0, le=(1 << 53) - 1)]
Frame = Annotated[int, msgspec.Meta(ge=0, le=(1 << 31) - 1)]
Word = Annotated[str, msgspec.Meta(min_length=1, max_length=200)]
Checksum = Annotated[str, msgspec.Meta(pattern=r"^[0-9a-f]{32}\Z")]


def matrix(T: NDArray[np.float64]) -> Matrix:
    """A (4, 4) transform as a manifest holds it."""
    rows = [tuple(row) for row in T.tolist()]
    return rows[0], rows[1], rows[2], rows[3]


def vector(values: NDArray[np.float64]) -> Vector:
    """Three numbers as a manifest holds them."""
    x, y, z = values.tolist()
    return x, y, z


class CaptureRecord(msgspec.Struct, frozen=True, kw_only=True):
    """The capture that a map was made from. path: a folder, a file, or ``builtin:room``.  frames: number of all its
    frames."""

    path: str
    format: str
    frames: Count = 0


class ChanceRecord(msgspec.Struct, frozen=True, kw_only=True):
    """What random words reach in a map; see ``query.chance``. evidence: that one in 40 reaches.  spread: standard
    deviation of the evidence of their best regions.  names: names of things of houses that are in the map.  center:
    (D,) float16, little-endian, the mean of the map's features; a map of a part keeps that of the whole."""

    evidence: Annotated[float, msgspec.Meta(gt=0, le=1e6)]
    spread: Annotated[float, msgspec.Meta(gt=0, le=1e6)]
    names: Annotated[
        list[Annotated[str, msgspec.Meta(min_length=1, max_length=200)]], msgspec.Meta(max_length=1000)
    ] = []
    center: Annotated[bytes, msgspec.Meta(max_length=1 << 17)] = b""

    @property
    def mean_feature(self) -> NDArray[np.float32] | None:
        """``center``; None if the map does not state it."""
        return np.frombuffer(self.center, "<f2").astype(np.float32) if self.center else None


class EncoderRecord(msgspec.Struct, frozen=True, kw_only=True):
    """The encoder of the features. state: restores the text encoder.  dimension: of the features.  chance: what random
    words reach, for an encoder of any words."""

    name: str
    dimension: Count = 0
    state: Any
    chance: ChanceRecord | None = None


class MapScale(msgspec.Struct, frozen=True, kw_only=True):
    """The unit of length. metric: whether it is the meter.  by: the source of the scale.  factor: meters per unit of
    the tracker."""

    metric: bool
    by: str = "sensor"
    factor: float = 1.0


class VoxelCounts(msgspec.Struct, frozen=True, kw_only=True):
    """Numbers of voxels of all sizes. Unknown voxels count within the blocks only."""

    occupied: Count
    free: Count
    unknown: Count = 0


class MapCounts(msgspec.Struct, frozen=True, kw_only=True):
    """Numbers of everything in the map. frames: of the capture."""

    gaussians: Count
    voxels: VoxelCounts
    frames: Count
    frames_with_pose: Count
    submaps: Count


class NameCount(msgspec.Struct, frozen=True, kw_only=True):
    """How many keyframes have a name, and which."""

    count: Count
    keyframes: tuple[Frame, ...] = ()


class SceneWords(msgspec.Struct, frozen=True, kw_only=True):
    """Names that a vision-language model gave. keyframes: those that it named.  names: most frequent first."""

    model: str = ""
    keyframes: tuple[Frame, ...]
    names: dict[str, NameCount]


class Upright(msgspec.Struct, frozen=True, kw_only=True):
    """How sure the upright frame of a map is. by: what up comes from, the surest first: "floor", "level surfaces",
    "walls", "cameras", or "one view": cameras that all look the same way, which tell no pitch.  off_deg: degrees from
    that up to the up of the cameras; for the cameras alone, by how much they were rolled.  floor: whether z = 0 is a
    floor, or else the level of the lowest points.  walls: whether x and y lie along walls, or else x along the first
    camera's view."""

    by: str
    off_deg: float
    floor: bool
    walls: bool

    @property
    def in_words(self) -> str:
        """The frame."""
        bottom = "the floor" if self.floor else "the lowest points"
        return f"z up, {bottom} at z = 0, {'walls along x and y' if self.walls else 'x along the first view'}"


class Refined(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """The map of larger voxels that this map refines. box: x0 y0 z0 x1 y1 z1 of the refined part, meters; None = the
    whole map."""

    map: str
    box: tuple[float, float, float, float, float, float] | None = None


class MapFacts(msgspec.Struct, frozen=True, kw_only=True):
    """What only the manifest states about a map."""

    capture: Annotated[CaptureRecord, _key("the capture that the map was made from")]
    frame: Annotated[str, _key("the frame of the map, in words")] = ""
    poses: Annotated[str, _key("the direction of the poses, in words")] = POSES
    scale: Annotated[MapScale, _key("the unit of length")] = MapScale(metric=True)
    world: Annotated[str, _key("the world of T_world_map, in words")] = ""
    up: Annotated[Vector, _key("unit vector x y z that points up in the map's frame")]
    upright: Annotated[Upright | None, _key("how sure the upright frame is; earlier maps do not stand upright")] = None
    T_world_map: Annotated[
        Matrix, _key("4 x 4, rigid, from the map's frame to the world of the given or tracked poses")
    ]
    T_first_camera: Annotated[
        Matrix | None, _key("4 x 4, rigid, from the map's frame to the first camera's: x right, y down, z forward")
    ] = None
    T_gravity_map: Annotated[Matrix | None, _key("4 x 4, rigid, to the frame with z up and the floor at z = 0")] = None
    encoder: Annotated[EncoderRecord, _key("the encoder of the features")]
    codec: Annotated[str, _key("how features are packed, in words")] = CODEC
    vocabulary: Annotated[SceneWords | None, _key("names that a model gave to things in the scene")] = None
    refined: Annotated[Refined | None, _key("the map of larger voxels that this map refines")] = None


class Manifest(MapFacts, frozen=True, kw_only=True):
    """The content of map.yaml: the facts, and what it repeats from the other files as a check."""

    freeocc3d: Annotated[str, _key("version of the package that wrote the map")]
    voxel_size_m: Annotated[float, _key("edge of the largest voxels, meters", gt=0)]
    finest_voxel_m: Annotated[float | None, _key("edge of the smallest voxels if sizes differ, meters", since=3)] = None
    origin: Annotated[Vector, _key("x y z of the lower corner of voxel (0, 0, 0), map's frame, meters")]
    counts: Annotated[MapCounts, _key("numbers of Gaussians, voxels, frames and submaps")]
    keyframes: Annotated[tuple[Frame, ...], _key("the capture's frames that are keyframes, ascending")]
    objects: Annotated[
        Count | None, _key("number of objects in objects.npz; absent where objects are found when they are asked for")
    ] = None
    files: Annotated[dict[str, Count], _key("files of the folder with their sizes, bytes")]
    checksums: Annotated[dict[str, Checksum] | None, _key("the same files with their checksums: XXH3 of 128 bits")] = (
        None
    )

    @property
    def finest_m(self) -> float:
        """Edge of the smallest voxels, meters."""
        return self.finest_voxel_m or self.voxel_size_m

    @property
    def format_version(self) -> int:
        """The newest version among the used keys."""
        return max(key.since for key in manifest_keys() if getattr(self, key.name) is not None)


class ManifestKey(NamedTuple):
    """A key of map.yaml, for the documentation. since: the format version that introduced it."""

    name: str
    required: bool
    since: int
    description: str


def manifest_keys() -> Iterator[ManifestKey]:
    """The keys of a manifest in the order of the file."""
    hints = get_type_hints(Manifest, include_extras=True)
    for field in msgspec.structs.fields(Manifest):
        meta: msgspec.Meta = hints[field.name].__metadata__[0]
        assert meta.extra is not None
        yield ManifestKey(field.name, field.required, meta.extra["since"], meta.description or "")


_SEAL = b"\n# xxh3_128 "
"""Before the checksum of all bytes of map.yaml that precede it: the last line, a comment. Who edits the file removes
the line; earlier maps have none."""


def write_manifest(folder: Path, manifest: Manifest) -> None:
    """Write map.yaml. Raises OSError."""
    content = {name: value for name, value in msgspec.to_builtins(manifest).items() if value is not None}
    text = dump_yaml({"format_version": manifest.format_version, **content})
    data = text.encode().rstrip(b"\n")
    (folder / MANIFEST).write_bytes(data + _SEAL + hash_bytes(data).encode() + b"\n")


def read_manifest(folder: Path) -> Manifest:
    """Read the manifest of a map folder. Raises MapError for a folder that is no map, an unknown format version, or a
    damaged manifest."""
    path = folder / MANIFEST
    if not folder.is_dir():
        raise MapError(f"The map folder {folder} does not exist.")
    try:
        data = read_bytes(path, _MOST_BYTES)
        content = parse_yaml(data)
    except FileNotFoundError as error:
        raise MapError(f"{folder} is not a map: it has no {MANIFEST}.") from error
    except OSError as error:
        raise MapError(f"{path} cannot be read: {error.strerror}.") from error
    except InvalidDocument as error:
        raise MapError(f"{path} is damaged: {error}.") from error
    body, seal, stated = data.rpartition(_SEAL)
    if seal and stated.strip() != hash_bytes(body).encode():
        raise MapError(
            f"{path} is damaged or was changed: its last line states another checksum. Copy the whole folder "
            "again; if you changed it on purpose, remove that line."
        )
    version = content.get("format_version") if isinstance(content, dict) else None
    if not isinstance(version, int) or isinstance(version, bool):
        raise MapError(f"{path} is not the manifest of a map: it has no format_version.")
    if version > FORMAT_VERSION:
        raise MapError(
            f"The map {folder} has format {version}; this freeocc3d reads up to {FORMAT_VERSION}: upgrade freeocc3d."
        )
    if version < OLDEST_VERSION:
        raise MapError(f"The map {folder} has the old format {version}: map the capture again.")
    try:
        manifest = as_type(content, Manifest)
    except InvalidDocument as error:
        raise MapError(f"{path} is damaged: {error}.") from error
    if problem := _problem(manifest):
        raise MapError(f"{path} is damaged: {problem}.")
    return manifest


def _problem(manifest: Manifest) -> str:
    """The problem of a manifest whose types are right; empty if it has none."""
    counts, keyframes = manifest.counts, np.array(manifest.keyframes, np.int64)
    ratio = manifest.voxel_size_m / manifest.finest_m
    if not (_among(manifest.voxel_size_m, _VOXELS) and _among(manifest.finest_m, _VOXELS)):
        return f"'voxel_size_m' or 'finest_voxel_m' is not finite, or not between {_VOXELS[0]:g} and {_VOXELS[1]:g}"
    if not any(abs(ratio / 2**level - 1) < _ALMOST for level in range(_LEVELS)):
        return "'finest_voxel_m' is not 'voxel_size_m' halved a few times"
    if not np.abs(np.array(manifest.origin)).max() <= _FARTHEST:
        return f"'origin' holds a number that is not finite, or farther than {_FARTHEST:g}"
    if not abs(np.linalg.norm(manifest.up) - 1) < _UNIT:
        return "'up' is not a unit vector"
    if not _among(manifest.scale.factor, _FACTORS):
        return f"'scale.factor' is not a finite number between {_FACTORS[0]:g} and {_FACTORS[1]:g}"
    for name in ("T_world_map", "T_gravity_map", "T_first_camera"):
        T = getattr(manifest, name)
        if T is not None and not (is_rigid(np.array(T)) and np.abs(np.array(T)).max() <= _FARTHEST):
            return f"'{name}' is not a rigid transform"
    if (np.diff(keyframes) <= 0).any() or (len(keyframes) and keyframes[-1] >= counts.frames):
        return "'keyframes' are not frames of the capture in ascending order"
    if not len(keyframes) <= counts.frames_with_pose <= counts.frames:
        return "'counts' holds fewer frames than have a pose or are keyframes"
    if manifest.refined and manifest.refined.box and not np.abs(np.array(manifest.refined.box)).max() <= _FARTHEST:
        return "'refined.box' holds a number that is not finite"
    if not _is_center(manifest.encoder):
        return "'encoder.chance.center' is not the mean of features of 'encoder.dimension'"
    if any("\0" in text for text in (manifest.capture.path, manifest.encoder.name)):
        return "'capture.path' or 'encoder.name' holds a character that no name has"
    outside = next((name for name in manifest.files if not _FILE.fullmatch(name)), None)
    return "" if outside is None else f"'files' names {outside[:200]}, which lies outside the map's folder"


def _is_center(encoder: EncoderRecord) -> bool:
    center = encoder.chance.center if encoder.chance else b""
    if not center:
        return True
    return len(center) == 2 * encoder.dimension and bool(np.linalg.norm(np.frombuffer(center, "<f2")) <= 1 + _UNIT)


def _among(value: float, bounds: tuple[float, float]) -> bool:
    return bounds[0] <= value <= bounds[1]
