"""A saved map. Opening it reads its manifest; each other part is read when it is first used.

Reading unpickles nothing, and checks the size of an array against its file before it allocates memory.
"""

from __future__ import annotations

import functools
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..core.depth_sensors import find_sensor
from ..core.errors import FreeOccError, MapError
from ..core.regular_files import stored_path
from ..core.transforms import invert
from ..core.tum_files import read_tum
from ..core.types import Gaussians, Occupancy, Trajectory
from ..settings import registry
from .checked_files import CheckedFiles
from .manifest import Manifest, read_manifest
from .map_files import CONFIG, FEATURES, GAUSSIANS, KEYFRAMES, MANIFEST, OBJECTS, OCCUPANCY, REPORT, TRAJECTORY
from .objects_file import ObjectArrays, read_objects
from .occupancy_file import read_codec, read_gaussian_codes, read_occupancy

if TYPE_CHECKING:
    from typing import Self

    from ..capture import Capture
    from ..language.encoders.base import Encoder, TextEncoder
    from ..language.feature_codec import Codec
    from ..settings.config import Settings
    from .keyframes import Keyframes


class SavedMap:
    """The parts of a map folder, as properties that are read when first used. Each raises MapError for a damaged
    file."""

    def __init__(self, path: Path, manifest: Manifest):
        self.path = path
        self.manifest = manifest
        self.files = CheckedFiles(path, manifest)

    @classmethod
    def open(cls, path: str | Path) -> Self:
        """Open a map folder: read the manifest, and check that every file in it exists and has its size.

        Raises MapError for a missing folder, a folder that is no map, a newer format, or a missing or damaged file.
        """
        path = Path(path)
        opened = cls(path, read_manifest(path))
        opened.files.check_sizes()
        return opened

    @property
    def up(self) -> NDArray[np.float64]:
        """(3,) unit vector that points up in the map's frame: z, unless the map was made before maps stood upright."""
        return np.array(self.manifest.up, np.float64)

    @property
    def metric(self) -> bool:
        """Whether lengths are meters; if not, their unit is unknown."""
        return self.manifest.scale.metric

    @functools.cached_property
    def T_gravity_map(self) -> NDArray[np.float64]:
        """(4, 4) to the frame with z up and the floor at z = 0: the map's own, unless it was made before maps stood
        upright. Estimated here for the earliest maps."""
        if self.manifest.T_gravity_map is None:
            from ..tracking.upright.upright_frame import estimate_gravity_frame

            return estimate_gravity_frame(self.trajectory.T_world_keyframe, self.gaussians)
        return np.array(self.manifest.T_gravity_map, np.float64)

    @property
    def T_first_camera(self) -> NDArray[np.float64] | None:
        """(4, 4) to the frame of the first camera with a pose: x right, y down, z forward. None without a pose."""
        if self.manifest.T_first_camera is not None:
            return np.array(self.manifest.T_first_camera, np.float64)
        posed = np.flatnonzero(self.trajectory.has_pose)
        return np.asarray(invert(self.trajectory.T_world_cam[posed[0]])) if len(posed) else None

    @functools.cached_property
    def settings(self) -> Settings:
        """The configuration that the map was made with."""
        from ..settings import config

        return config.load_saved(self.files.path(CONFIG))

    @functools.cached_property
    def capture(self) -> Capture:
        """The capture that the map was made from, opened with the same options and the focal length of the color camera
        that the run found. Raises FreeOccError if it no longer exists or has changed."""
        from ..capture import open_capture
        from ..capture.focal_correction import Reregistered

        path: str | Path = self.manifest.capture.path
        if not str(path).startswith("builtin:"):
            path = stored_path(str(path))
        if isinstance(path, Path) and not path.exists():
            raise FreeOccError(f"The capture {path}, from which {self.path} was made, no longer exists.")
        opened = open_capture(path, self.settings.capture, self.settings.backends.get("capture"))
        color_focal = float(self.report.get("color_focal", 1.0))
        return opened if color_focal == 1 else Reregistered(opened, color_focal)

    @functools.cached_property
    def occupancy(self) -> Occupancy:
        """The voxels with probabilities, evidence, features and colors."""
        return read_occupancy(self.files.path(OCCUPANCY), self.manifest, self._codec)

    @functools.cached_property
    def gaussians(self) -> Gaussians:
        """The anchored Gaussians."""
        from ..gaussians.point_cloud import read_gaussian_ply

        path = self.files.path(GAUSSIANS)
        gaussians = read_gaussian_ply(path, len(self.manifest.keyframes))
        if len(gaussians) != self.manifest.counts.gaussians:
            raise MapError(f"{path} is damaged: it holds another number of Gaussians than {MANIFEST} states.")
        return gaussians

    @functools.cached_property
    def gaussian_features(self) -> NDArray[np.float16]:
        """(N, D) unit features of the Gaussians."""
        return self._codec.decode(read_gaussian_codes(self.files.path(FEATURES), self.manifest, self._codec))

    @functools.cached_property
    def kept_objects(self) -> ObjectArrays | None:
        """The objects that the map keeps; None if they are to be found."""
        return None if self.manifest.objects is None else read_objects(self.files.path(OBJECTS), self.manifest)

    @functools.cached_property
    def trajectory(self) -> Trajectory:
        """Poses, status and confidence of all frames of the capture."""
        log, path = self.report["frame_log"], self.files.path(TRAJECTORY)
        timestamps, keyframes = np.array(log["timestamp"], np.float64), np.array(self.manifest.keyframes, np.int32)
        try:
            times, T = read_tum(path)
        except (OSError, ValueError) as error:
            raise MapError(f"{path} is damaged: {getattr(error, 'strerror', None) or error}.") from error
        counts = self.manifest.counts
        if len(timestamps) != counts.frames or len(times) != counts.frames_with_pose:
            raise MapError(f"{self.path} is damaged: {REPORT}, {TRAJECTORY} and {MANIFEST} count different frames.")
        posed = _of_frames(timestamps, times, T)
        if not np.isfinite(posed[keyframes]).all():
            raise MapError(f"{path} is damaged: it lacks the pose of a keyframe.")
        return Trajectory(
            timestamps=timestamps,
            T_world_cam=posed,
            keyframes=keyframes,
            status=np.array(log["status"], dtype="<U12"),
            confidence=np.array(log["confidence"], np.float32),
        )

    @functools.cached_property
    def report(self) -> dict[str, Any]:
        """Timings, used and lost frames, memory and warnings of the run that made the map."""
        from .report_file import read_report

        return read_report(self.files.path(REPORT))

    @functools.cached_property
    def keyframes(self) -> Keyframes:
        """The keyframes' images."""
        from .keyframes import INDEX, Keyframes

        self.files.path(f"{KEYFRAMES}/{INDEX}")
        loaded = Keyframes.load(self.path / KEYFRAMES, lambda path: self.files.path(f"{KEYFRAMES}/{path.name}"))
        loaded.sensor = find_sensor(self.settings.capture.sensor)
        if loaded.frames != list(self.manifest.keyframes):
            raise MapError(f"{self.path} is damaged: {MANIFEST} and the folder {KEYFRAMES} list different keyframes.")
        return loaded

    @functools.cached_property
    def encoder(self) -> Encoder:
        """The image encoder that the map was made with, with the same options. Raises FreeOccError if it cannot be
        loaded, or needs a capture that no longer exists."""
        loaded: Encoder = self.settings.load_backend("language", self.capture if self.encoder_needs_capture else None)
        return loaded

    @property
    def encoder_needs_capture(self) -> bool:
        """Whether the encoder reads more of a frame than its color image."""
        module = registry.load("language.encoders", self.manifest.encoder.name)
        return bool(getattr(module, "NEEDS_CAPTURE", True))

    @functools.cached_property
    def text_encoder(self) -> TextEncoder:
        """The text encoder that the map was made with."""
        encoder = self.manifest.encoder
        module = registry.load("language.encoders", encoder.name)
        try:
            restored: TextEncoder = module.load_text(encoder.state)
        except (AttributeError, KeyError, TypeError, ValueError) as error:
            raise MapError(
                f"{self.path / MANIFEST} is damaged: 'encoder.state' is not what the encoder '{encoder.name}' saves."
            ) from error
        return restored

    @property
    def mean_feature(self) -> NDArray[np.float32]:
        """(D,) mean of the features of the map, or of the map that it is a part of."""
        from ..language.feature_codec import average_known

        chance = self.manifest.encoder.chance
        stated = chance.mean_feature if chance else None
        return average_known(self.occupancy.features) if stated is None else stated

    @property
    def vocabulary(self) -> list[str]:
        """The words that pictures and exports use as classes: the encoder's contrast words; with an open vocabulary,
        the names that a model gave to the scene, or else those of things of houses that are in it, if there are any."""
        chance = self.manifest.encoder.chance
        found = chance.names if chance else []
        named = self.scene_words or found if self.text_encoder.open_vocabulary else []
        return named or self.text_encoder.contrast_words()

    @property
    def scene_words(self) -> list[str]:
        """Names that a vision-language model gave to things in the scene, most frequent first. A name that only one of
        several keyframes has is left out: most things are seen twice."""
        named = self.manifest.vocabulary
        if named is None:
            return []
        least = 2 if len(named.keyframes) > 3 else 1
        count = {name: entry.count for name, entry in named.names.items() if entry.count >= least}
        return sorted(count, key=lambda name: -count[name])

    @functools.cached_property
    def _codec(self) -> Codec:
        return read_codec(self.files.path(FEATURES))


def _of_frames(
    timestamps: NDArray[np.float64], times: NDArray[np.float64], T: NDArray[np.float64]
) -> NDArray[np.float64]:
    """(N, 4, 4) pose of each timestamp; NaN where the trajectory has none."""
    out = np.full((len(timestamps), 4, 4), np.nan)
    row = np.clip(np.searchsorted(timestamps, times), 0, max(len(timestamps) - 1, 0))
    out[row[timestamps[row] == times]] = T[timestamps[row] == times]
    return out
