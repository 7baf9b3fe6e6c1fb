"""COLMAP's database of a scan: cameras, features, matches and verified pairs, each stored once.

Frame n of the capture is image n + 1, with the name ``image_name(n)``. COLMAP's pixel centers lie at half-integers.
"""

from __future__ import annotations

import contextlib
import sqlite3
import tempfile
from collections.abc import Iterable, Sequence
from pathlib import Path
from types import TracebackType

import numpy as np
import pycolmap
from numpy.typing import NDArray

from ...core.types import Intrinsics
from .local_features import LocalFeatures

_BYTES = pycolmap.FeatureExtractorType.SIFT
_FLOATS = pycolmap.FeatureExtractorType.ALIKED_N16ROT  # any type with float descriptors; only the database uses it
_SIFT_NORM = np.float32(512)

CAMERA = 1


def image_name(frame: int) -> str:
    """The frame's name in the database and in models made from it."""
    return f"{frame:06d}"


class SfmDatabase:
    """An open database, closed at the end of ``with``. It keeps the content of an interrupted run, unless its file was
    damaged."""

    def __init__(self, path: Path):
        self.path = path
        if not _is_whole(path):
            path.unlink(missing_ok=True)
        self._database = pycolmap.Database.open(path)

    def __enter__(self) -> SfmDatabase:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._database.close()

    def set_camera(self, model: str, camera: Intrinsics, known: bool) -> None:
        """Store the shared camera of all images, unless the database has one."""
        if self._database.exists_camera(CAMERA):
            return
        focal = 0.5 * (camera.fx + camera.fy)
        made = pycolmap.Camera.create_from_model_name(CAMERA, model, focal, camera.width, camera.height)
        made.principal_point_x, made.principal_point_y = camera.cx + 0.5, camera.cy + 0.5
        if len(made.focal_length_idxs()) == 2:
            made.focal_length_x, made.focal_length_y = camera.fx, camera.fy
        made.has_prior_focal_length = known
        self._database.write_camera(made, use_camera_id=True)
        rig = pycolmap.Rig(rig_id=CAMERA)
        rig.add_ref_sensor(made.sensor_id)
        self._database.write_rig(rig, use_rig_id=True)

    def add(self, frame: int, features: LocalFeatures) -> None:
        """Store a frame's features."""
        image = pycolmap.Image(name=image_name(frame), camera_id=CAMERA, image_id=frame + 1)
        image.frame_id = frame + 1
        moment = pycolmap.Frame(frame_id=frame + 1, rig_id=CAMERA)
        moment.add_data_id(image.data_id)
        if features.descriptors.dtype == np.uint8:
            kept = pycolmap.FeatureDescriptors(_BYTES, features.descriptors)
        else:
            kept = pycolmap.FeatureDescriptorsFloat(_FLOATS, features.descriptors).to_bytes()
        with pycolmap.DatabaseTransaction(self._database):
            self._database.write_frame(moment, use_frame_id=True)
            self._database.write_image(image, use_image_id=True)
            self._database.write_keypoints(frame + 1, features.pixels + np.float32(0.5))
            self._database.write_descriptors(frame + 1, kept)

    def frames(self) -> list[int]:
        """The stored frames, ascending."""
        return sorted(image.image_id - 1 for image in self._database.read_all_images())

    def pixels(self, frame: int) -> NDArray[np.float32]:
        """(N, 2) pixels of a frame's features."""
        return np.asarray(self._database.read_keypoints(frame + 1)[:, :2] - np.float32(0.5))

    def descriptors(self, frame: int) -> NDArray[np.float32]:
        """(N, D) descriptors of a frame's features, of unit length."""
        kept = self._database.read_descriptors(frame + 1)
        if kept.type == _FLOATS:
            return np.array(kept.to_float().data, np.float32)
        return kept.data.astype(np.float32) / _SIFT_NORM

    def verified(self) -> set[tuple[int, int]]:
        """Pairs of frames (i < j) whose verification is done, with any result."""
        ids, _ = self._database.read_two_view_geometry_num_inliers()
        found = (pycolmap.pair_id_to_image_pair(pair) for pair in ids)
        return {(min(a, b) - 1, max(a, b) - 1) for a, b in found}

    def add_matches(self, pairs: Sequence[tuple[int, int]], matches: Iterable[NDArray[np.uint32]]) -> None:
        """Store the matches of pairs of frames, and verify them by geometry."""
        with pycolmap.DatabaseTransaction(self._database):
            for (i, j), rows in zip(pairs, matches, strict=True):
                if not self._database.exists_matches(i + 1, j + 1):
                    self._database.write_matches(i + 1, j + 1, rows)
        options = pycolmap.TwoViewGeometryOptions()
        options.ransac.random_seed = 0
        with tempfile.NamedTemporaryFile("w", suffix=".txt") as names:
            names.writelines(f"{image_name(i)} {image_name(j)}\n" for i, j in pairs)
            names.flush()
            pycolmap.verify_matches(self.path, names.name, options)

    def geometries(self) -> list[tuple[int, int, str, int]]:
        """(frame, frame, kind of geometry, number of inliers) of the verified pairs."""
        ids, found = self._database.read_two_view_geometries()
        pairs = (pycolmap.pair_id_to_image_pair(pair) for pair in ids)
        return [
            (a - 1, b - 1, pycolmap.TwoViewGeometryConfiguration(geometry.config).name, len(geometry.inlier_matches))
            for (a, b), geometry in zip(pairs, found, strict=True)
        ]

    def displacement(self, i: int, j: int) -> float:
        """Median displacement, pixels, of the verified matches of two frames."""
        rows = self._database.read_two_view_geometry(i + 1, j + 1).inlier_matches
        return float(np.median(np.linalg.norm(self.pixels(i)[rows[:, 0]] - self.pixels(j)[rows[:, 1]], axis=1)))

    def size(self) -> tuple[int, int]:
        """Width and height of the images."""
        camera = self._database.read_camera(CAMERA)
        return camera.width, camera.height


def _is_whole(path: Path) -> bool:
    """Whether SQLite can read the whole file."""
    try:
        with contextlib.closing(sqlite3.connect(path)) as database:
            return database.execute("PRAGMA integrity_check").fetchone() == ("ok",)
    except sqlite3.Error:
        return False
