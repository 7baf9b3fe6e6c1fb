"""COLMAP's database: what is stored comes back, and verified pairs tell how far their features moved."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pycolmap
import pytest

from freeocc3d.core.types import Intrinsics
from freeocc3d.tracking.sfm.database import SfmDatabase, image_name
from freeocc3d.tracking.sfm.local_features import LocalFeatures
from freeocc3d.tracking.sfm.mapping import silence_colmap

CAMERA = Intrinsics(640, 480, 500.0, 510.0, 321.0, 237.0)


def seen(count: int = 120) -> list[LocalFeatures]:
    """Points in a box from three cameras side by side; the third sees nothing that the others do."""
    silence_colmap()
    rng = np.random.default_rng(0)
    points = rng.uniform((-1, -1, 3), (1, 1, 6), (count, 3))
    found = []
    for x in (0.0, 0.4, 0.0):
        moved = points - (x, 0, 0) if len(found) < 2 else rng.uniform((-1, -1, 3), (1, 1, 6), (count, 3))
        pixels = moved[:, :2] / moved[:, 2:] * (CAMERA.fx, CAMERA.fy) + (CAMERA.cx, CAMERA.cy)
        rows = rng.normal(size=(count, 128))
        rows *= 512 / np.linalg.norm(rows, axis=1, keepdims=True)
        found.append(LocalFeatures(pixels.astype(np.float32), np.abs(rows).astype(np.uint8)))
    return found


@pytest.mark.parametrize(("model", "known"), [("SIMPLE_PINHOLE", True), ("PINHOLE", False)])
def test_the_camera_is_stored_once_with_colmaps_pixel_centers(tmp_path: Path, model: str, known: bool) -> None:
    with SfmDatabase(tmp_path / "a.db") as database:
        database.set_camera(model, CAMERA, known)
        database.set_camera("PINHOLE", Intrinsics(10, 10, 5.0, 5.0, 5.0, 5.0), not known)
        assert database.size() == (640, 480)
    camera = pycolmap.Database.open(tmp_path / "a.db").read_camera(1)
    assert camera.has_prior_focal_length == known
    focal = [505.0] if model == "SIMPLE_PINHOLE" else [500.0, 510.0]
    np.testing.assert_allclose(camera.params, [*focal, 321.5, 237.5])


def test_features_and_verified_pairs_come_back(tmp_path: Path) -> None:
    features = seen()
    frames = (7, 0, 30)
    with SfmDatabase(tmp_path / "a.db") as database:
        database.set_camera("PINHOLE", CAMERA, True)
        for frame, one in zip(frames, features, strict=True):
            database.add(frame, one)
        assert database.frames() == [0, 7, 30]
        for frame, one in zip(frames, features, strict=True):
            np.testing.assert_allclose(database.pixels(frame), one.pixels, atol=1e-4)
            np.testing.assert_allclose(database.descriptors(frame), one.descriptors / np.float32(512))
        rows = np.stack([np.arange(120)] * 2, axis=1).astype(np.uint32)
        database.add_matches([(0, 7), (7, 30)], [rows, rows])
        assert database.verified() == {(0, 7), (7, 30)}
        told = {(a, b): (kind, inliers) for a, b, kind, inliers in database.geometries()}
        assert told[0, 7][0] == "CALIBRATED"
        assert told[0, 7][1] > 110
        assert told[7, 30][1] < 30
        way = np.linalg.norm(features[0].pixels - features[1].pixels, axis=1)
        assert database.displacement(0, 7) == pytest.approx(np.median(way), rel=0.03)
    with SfmDatabase(tmp_path / "a.db") as again:
        assert again.frames() == [0, 7, 30]
        assert again.verified() == {(0, 7), (7, 30)}


def test_descriptors_of_a_network_come_back_as_floats(tmp_path: Path) -> None:
    rows = np.random.default_rng(0).normal(size=(5, 64)).astype(np.float32)
    with SfmDatabase(tmp_path / "a.db") as database:
        database.set_camera("PINHOLE", CAMERA, True)
        database.add(3, LocalFeatures(np.zeros((5, 2), np.float32), rows))
        np.testing.assert_array_equal(database.descriptors(3), rows)
    assert image_name(3) == "000003"
