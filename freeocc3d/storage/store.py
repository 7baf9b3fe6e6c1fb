"""The map folder: what is in it, saving it whole, loading it lazily.

    map.yaml  config.yaml  report.json  trajectory.txt  trajectory.png  gaussians.ply  occupancy.npz  features.npz
    keyframes/

Loading reads the manifest only; each part is read when it is first asked for, so that a query pays for nothing else.
Nothing is unpickled, and an array's size is checked against its file's before memory is taken.
"""

from __future__ import annotations

import functools
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import yaml
from numpy.typing import NDArray

from ..core.arrays import read_arrays
from ..core.errors import MapError
from ..core.transforms import is_rigid
from ..core.tum_files import read_tum
from ..core.types import BLOCK, FREE, OCCUPIED, UNKNOWN, Gaussians, Occupancy, Trajectory
from ..language.feature_codec import Codec, CodedFeatures
from ..settings import registry, typed_options
from .manifest import MANIFEST, check_manifest

if TYPE_CHECKING:
    from ..language.encoders.base import TextEncoder
    from ..query.best_views import View
    from ..query.conditions import Where
    from ..query.oriented_boxes import OrientedBox
    from ..query.regions import Region
    from ..query.word_query import Options, QueryResult
    from .keyframes import Keyframes

FORMAT_VERSION = 3
_UNIFORM_VERSION = 2
"""Of maps whose voxels are all of one size, which earlier versions read as well."""
CONFIG, REPORT, TRAJECTORY = "config.yaml", "report.json", "trajectory.txt"
PATH_PICTURE, RENDER_PICTURE = "trajectory.png", "gaussians.png"
GAUSSIANS, OCCUPANCY, FEATURES, KEYFRAMES = "gaussians.ply", "occupancy.npz", "features.npz", "keyframes"

_DEEPEST = 12
"""Level of the smallest voxels of any map: from 4 m down to a millimetre."""
_OCCUPANCY_ARRAYS = {
    "keys": ("i", 2), "probability": ("f", 2), "free": ("u", 2), "hits": ("u", 2), "state": ("u", 2),
    "colors": ("u", 2), "feature_codes": ("u", 2),
}  # fmt: skip
"""Arrays of occupancy.npz: kind of number and dimensions."""
_FEATURE_ARRAYS = {
    "gaussian_codes": ("u", 2), "codec_basis": ("f", 2), "codec_bits": ("u", 1), "codec_offset": ("f", 1),
    "codec_scale": ("f", 1),
}  # fmt: skip


class Map:
    """A saved map. ``query("red cup")`` asks it; its parts are properties that are read when first used."""

    def __init__(self, path: Path, manifest: dict[str, Any]):
        self.path = path
        self.manifest = manifest

    @property
    def up(self) -> NDArray[np.float64]:
        """(3,) unit vector that points up in the map's frame, as well as the camera's attitude tells."""
        return np.array(self.manifest["up"], np.float64)

    @property
    def metric(self) -> bool:
        """Whether lengths are metres; where not, their unit is unknown."""
        return bool(self.manifest.get("scale", {}).get("metric", True))

    @functools.cached_property
    def T_gravity_map(self) -> NDArray[np.float64]:
        """(4, 4) to the frame with z up and the floor at z = 0; found now where an earlier version made the map."""
        if "T_gravity_map" not in self.manifest:
            from ..occupancy.gravity_frame import estimate_gravity_frame

            return estimate_gravity_frame(self.trajectory.T_world_keyframe, self.gaussians)
        T = np.array(self.manifest["T_gravity_map"], np.float64)
        if not is_rigid(T):
            raise MapError(f"{self.path / MANIFEST} is damaged: 'T_gravity_map' is no rigid transform.")
        return T

    @functools.cached_property
    def occupancy(self) -> Occupancy:
        """The voxels with probabilities, evidence, features and colours."""
        arrays = read_arrays(self.path / OCCUPANCY, _OCCUPANCY_ARRAYS)
        blocks = len(arrays["keys"])
        occupied = int(np.count_nonzero(arrays["state"] == OCCUPIED))
        levels = arrays.get("levels", np.zeros(blocks, np.uint8))
        arrays_fit = (
            arrays["keys"].shape == (blocks, 3)
            and all(arrays[name].shape == (blocks, BLOCK**3) for name in ("probability", "free", "hits", "state"))
            and arrays["colors"].shape == (occupied, 3)
            and arrays["feature_codes"].shape == (occupied, self._codec.code_bytes)
            and levels.shape == (blocks,)
            and levels.dtype == np.uint8
            and levels.max(initial=0) <= _DEEPEST
        )
        if not arrays_fit:
            raise MapError(f"{self.path / OCCUPANCY} is damaged: its arrays do not belong together.")
        return Occupancy(
            voxel_size=float(self.manifest["voxel_size_m"]),
            origin=np.array(self.manifest["origin"], np.float64),
            keys=arrays["keys"].astype(np.int32),
            probability=arrays["probability"].astype(np.float32),
            free=arrays["free"].astype(np.uint16),
            hits=arrays["hits"].astype(np.uint16),
            state=arrays["state"].astype(np.uint8),
            features=cast(Any, CodedFeatures(self._codec, arrays["feature_codes"])),
            colors=arrays["colors"].astype(np.uint8),
            levels=levels,
        )

    @functools.cached_property
    def gaussians(self) -> Gaussians:
        """The anchored Gaussians (imports Open3D)."""
        from ..gaussians.point_cloud import read_gaussian_ply

        self._require(GAUSSIANS)
        return read_gaussian_ply(self.path / GAUSSIANS)

    @functools.cached_property
    def gaussian_features(self) -> NDArray[np.float16]:
        """(N, D) unit features of the Gaussians."""
        return self._codec.decode(self._feature_arrays["gaussian_codes"])

    @functools.cached_property
    def trajectory(self) -> Trajectory:
        """Poses, status and confidence of all frames of the capture."""
        try:
            log = self.report["frame_log"]
            timestamps = np.array(log["timestamp"], np.float64)
            return Trajectory(
                timestamps=timestamps,
                T_world_cam=_place(timestamps, *read_tum(self.path / TRAJECTORY)),
                keyframes=np.array(self.manifest["keyframes"], np.int32),
                status=np.array(log["status"], dtype="<U12"),
                confidence=np.array(log["confidence"], np.float32),
            )
        except (OSError, KeyError, TypeError, ValueError) as error:
            raise MapError(f"{self.path / REPORT} or {TRAJECTORY} is damaged: {error}.") from error

    @functools.cached_property
    def report(self) -> dict[str, Any]:
        """Timings, frames used and lost, memory, warnings of the run that made the map."""
        try:
            return dict(json.loads((self.path / REPORT).read_text(encoding="utf-8")))
        except (OSError, ValueError) as error:
            raise MapError(f"Cannot read {self.path / REPORT}: {error}.") from error

    @functools.cached_property
    def keyframes(self) -> Keyframes:
        """The keyframes' images."""
        from .keyframes import Keyframes

        return Keyframes.load(self.path / KEYFRAMES)

    @functools.cached_property
    def text_encoder(self) -> TextEncoder:
        """The word side of the encoder that the map was built with."""
        encoder = self.manifest["encoder"]
        restored: TextEncoder = registry.load("language.encoders", encoder["name"]).load_text(encoder["state"])
        return restored

    @property
    def vocabulary(self) -> list[str]:
        """The words that pictures and exports by class use: what the encoder tells apart without being asked, or of one
        of open vocabulary, what a model has named in the scene."""
        named = self.scene_words if self.text_encoder.open_vocabulary else []
        return named or self.text_encoder.contrast_words()

    @property
    def scene_words(self) -> list[str]:
        """Names that a vision-language model gave to what is in the scene, the most frequent first. A name that only
        one of several keyframes has is left out: what is there is mostly seen twice."""
        named = self.manifest.get("vocabulary") or {"keyframes": [], "names": {}}
        least = 2 if len(named["keyframes"]) > 3 else 1
        count = {name: entry["count"] for name, entry in named["names"].items() if entry["count"] >= least}
        return sorted(count, key=lambda name: -count[name])

    @functools.cached_property
    def _class_labels(self) -> NDArray[np.uint8]:
        from ..query import word_query

        text = self.text_encoder.encode_words(self.vocabulary[:253])
        return (word_query.nearest_word(self.occupancy.features, text) + 1).astype(np.uint8)

    def labels(self) -> NDArray[np.uint8]:
        """(V,) class of each occupied voxel: 0 = nothing known, k = ``vocabulary[k - 1]``."""
        return self._class_labels

    def query(self, word: str, **options: Any) -> QueryResult:
        """Where ``word`` is: regions with score, box, centroid and volume. ``options``: fields of ``query.Options``."""
        return self.query_words([word], **options)[0]

    def query_words(
        self,
        words: list[str],
        contrast: Sequence[str] = (),
        negative: Sequence[str] = (),
        where: Where | None = None,
        **options: Any,
    ) -> list[QueryResult]:
        """``query`` for several words. contrast: words for what else is there, besides the encoder's own.  negative:
        words for what is not meant.  where: conditions on the regions' places; see ``relations.Where``."""
        return self._placed(lambda asked: self._words(words, asked, contrast, negative), where, options)

    def query_classes(self, names: list[str], where: Where | None = None, **options: Any) -> list[QueryResult]:
        """The voxels whose nearest name of ``vocabulary`` is each of these; see that module. Of the options ``top_k``
        and ``narrow`` count."""
        from ..query.class_query import query_classes

        ask = functools.partial(query_classes, self.occupancy, self.text_encoder, self.vocabulary, names, up=self.up)
        return self._placed(ask, where, options)

    def query_image(
        self,
        image: str | Path | NDArray[np.uint8],
        box: tuple[int, int, int, int] | None = None,
        where: Where | None = None,
        **options: Any,
    ) -> QueryResult:
        """Where it looks as in a picture, a file or (H, W, 3) RGB, or in a box x0 y0 x1 y1 of its pixels; see
        ``patches``."""
        from ..query import image_query

        encoder = image_query.image_encoder(self.manifest["encoder"]["name"], self.path / CONFIG)
        feature = image_query.patch_feature(encoder, image, box)
        name = "the picture" if isinstance(image, np.ndarray) else Path(image).name
        found = self._placed(
            lambda asked: [image_query.query_feature(self.occupancy, feature, name, asked, self.up)], where, options
        )
        return found[0]

    def _words(
        self, words: list[str], options: Options, contrast: Sequence[str] = (), negative: Sequence[str] = ()
    ) -> list[QueryResult]:
        from ..query import word_query

        named = self.scene_words if self.text_encoder.open_vocabulary else []
        others = [*named, *contrast]
        return word_query.query(self.occupancy, self.text_encoder, words, options, others, negative, self.up)

    def _placed(
        self, ask: Callable[[Options], list[QueryResult]], where: Where | None, options: dict[str, Any]
    ) -> list[QueryResult]:
        """What a question finds, in the places that are asked for."""
        from ..query import conditions, word_query

        checked = typed_options.build(word_query.Options, options)
        if where is None:
            return ask(checked)
        every = checked.changed(top_k=max(len(self.occupancy.colors), 1))
        references = self._words(where.words, every) if where.words else []
        return conditions.only_where(self.occupancy, self.up, ask(every), references, where, checked.top_k)

    def box_of(self, region: Region) -> OrientedBox:
        """The upright box of least level area around a region, turned as the region is."""
        from ..query.oriented_boxes import oriented_boxes

        return oriented_boxes(self.occupancy, [region], self.T_gravity_map)[0]

    def views_of(self, region: Region) -> list[View]:
        """The up to three keyframes that show a region best, with the pixel box in each; see ``region_views``."""
        from ..query.best_views import best_views

        return best_views(self.occupancy, self.trajectory, self.keyframes, [region])[0]

    def stand_of(self, region: Region) -> NDArray[np.float64] | None:
        """(3,) the nearest place on the floor, map frame, where a robot could stand and see a region; see
        ``standing_places``."""
        return self.standing_places([region])[0]

    def standing_places(self, regions: Sequence[Region]) -> list[NDArray[np.float64] | None]:
        """``stand_of`` for several regions: see ``standing``. None throughout where lengths are not metres, for a robot
        has a size."""
        if not regions or not self.metric:
            return [None] * len(regions)
        from ..query.standing_places import standing_places

        return standing_places(self.occupancy, self.T_gravity_map, regions)

    @functools.cached_property
    def _feature_arrays(self) -> dict[str, NDArray[Any]]:
        return read_arrays(self.path / FEATURES, _FEATURE_ARRAYS)

    @functools.cached_property
    def _codec(self) -> Codec:
        arrays = self._feature_arrays
        tables = {name.removeprefix("codec_"): table for name, table in arrays.items() if name.startswith("codec_")}
        try:
            codec = Codec.from_tables(tables)
        except ValueError as error:
            raise MapError(f"{self.path / FEATURES} is damaged: {error}.") from error
        if arrays["gaussian_codes"].shape[1] != codec.code_bytes:
            raise MapError(f"{self.path / FEATURES} is damaged: its codes do not belong to its codec.")
        return codec

    def _require(self, name: str) -> None:
        expected = self.manifest["files"].get(name)
        try:
            size = (self.path / name).stat().st_size
        except OSError as error:
            raise MapError(f"The map {self.path} lacks its {name}: copy the whole folder, or map again.") from error
        if size != expected:
            raise MapError(f"{self.path / name} is damaged: it has {size} bytes in place of {expected}.")


def load_map(path: str | Path) -> Map:
    """Open a map folder: the manifest is read, and every file that it lists must be there and have its size.

    Raises MapError: no such folder, not a map, from a newer version, a missing or damaged file.
    """
    path = Path(path)
    if not path.is_dir():
        raise MapError(f"There is no map folder {path}.")
    try:
        manifest = yaml.load((path / MANIFEST).read_text(encoding="utf-8"), Loader=_SafeLoader)
    except FileNotFoundError as error:
        raise MapError(f"{path} is not a map: it has no {MANIFEST}.") from error
    except (OSError, yaml.YAMLError, UnicodeDecodeError) as error:
        raise MapError(f"{path / MANIFEST} cannot be read: {' '.join(str(error).split())}.") from error
    version = manifest.get("format_version") if isinstance(manifest, dict) else None
    if not isinstance(version, int):
        raise MapError(f"{path / MANIFEST} is not a map's manifest: it states no format_version.")
    if version > FORMAT_VERSION:
        raise MapError(
            f"The map {path} has format {version}, this freeocc3d reads up to {FORMAT_VERSION}: upgrade freeocc3d."
        )
    if version < _UNIFORM_VERSION:
        raise MapError(f"The map {path} has format {version}, of an earlier freeocc3d: map the capture again.")
    check_manifest(manifest, path)
    loaded = Map(path, manifest)
    for name in manifest["files"]:
        loaded._require(name)
    return loaded


def write_manifest(folder: Path, manifest: Mapping[str, Any]) -> None:
    """Write map.yaml with the sizes of the map's files beside it. Raises OSError."""
    parts = (CONFIG, REPORT, TRAJECTORY, GAUSSIANS, OCCUPANCY, FEATURES)
    pictures = (folder / name for name in (PATH_PICTURE, RENDER_PICTURE) if (folder / name).is_file())
    paths = [*(folder / name for name in parts), *pictures, *sorted((folder / KEYFRAMES).iterdir())]
    files = {path.relative_to(folder).as_posix(): path.stat().st_size for path in paths}
    version = FORMAT_VERSION if "finest_voxel_m" in manifest else _UNIFORM_VERSION
    content = {"format_version": version, **manifest, "files": files}
    (folder / MANIFEST).write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")


def write_occupancy(folder: Path, occupancy: Occupancy, codec: Codec, gaussian_features: NDArray[np.float16]) -> None:
    """Write occupancy.npz and features.npz. Raises OSError."""
    levels: dict[str, Any] = {"levels": occupancy.levels} if occupancy.deepest else {}
    np.savez_compressed(
        folder / OCCUPANCY,
        keys=occupancy.keys,
        probability=occupancy.probability.astype(np.float16),
        free=occupancy.free,
        hits=occupancy.hits,
        state=occupancy.state,
        colors=occupancy.colors,
        feature_codes=codec.encode(occupancy.features),
        **levels,
    )
    tables: dict[str, Any] = {f"codec_{name}": table for name, table in codec.tables().items()}
    np.savez_compressed(folder / FEATURES, gaussian_codes=codec.encode(gaussian_features), **tables)


def _place(timestamps: NDArray[np.float64], times: NDArray[np.float64], T: NDArray[np.float64]) -> NDArray[np.float64]:
    """(N, 4, 4) with the pose of each timestamp that a trajectory has, NaN elsewhere."""
    out = np.full((len(timestamps), 4, 4), np.nan)
    row = np.clip(np.searchsorted(timestamps, times), 0, max(len(timestamps) - 1, 0))
    out[row[timestamps[row] == times]] = T[timestamps[row] == times]
    return out


def sizes(occupancy: Occupancy) -> dict[str, Any]:
    """What a manifest says of the voxels' sizes: their edges, metres."""
    several = {"finest_voxel_m": occupancy.finest} if occupancy.deepest else {}
    return {"voxel_size_m": occupancy.voxel_size, **several}


def counts(occupancy: Occupancy) -> dict[str, int]:
    """Number of occupied, free and (within the blocks) unknown voxels, of any size."""
    return {
        name: int(np.count_nonzero(occupancy.state == value))
        for name, value in (("occupied", OCCUPIED), ("free", FREE), ("unknown", UNKNOWN))
    }


_SafeLoader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
