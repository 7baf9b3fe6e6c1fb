"""The result of structure from motion: its scale, and its file."""

from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

from freeocc3d.capture.cameras.lenses import Lens
from freeocc3d.core.errors import MapError
from freeocc3d.core.types import Intrinsics
from freeocc3d.core.warnings import Notice
from freeocc3d.tracking.sfm.reconstruction import Reconstruction


def reconstruction() -> Reconstruction:
    """Three frames, the second without a pose, that look along z at points 5 away."""
    T = np.stack([np.eye(4)] * 3)
    T[1] = np.nan
    T[2, 0, 3] = 1.0
    points = np.array([(0, 0, 5), (1, 0, 5), (0, 1, 7)], np.float32)
    return Reconstruction(
        T, Lens(Intrinsics(64, 48, 50.0, 51.0, 31.5, 23.5), (0.1, 0.0, 0.0, 0.0)), points,
        np.array([0, 0, 2, 2], np.int32), np.array([0, 1, 1, 2], np.int32), False,
        np.array([False, True, False]), np.ones(3, bool), (Notice("models-apart", "it fell into two"),),
    )  # fmt: skip


def test_the_median_depth_is_two_unless_the_scale_is_known() -> None:
    found = reconstruction()
    np.testing.assert_allclose(found.depths(), [5, 5, 5, 7])
    normal = found.normalized()
    assert np.median(normal.depths()) == pytest.approx(2.0)
    np.testing.assert_allclose(normal.T_world_cam[2, :3, 3], [0.4, 0, 0])
    np.testing.assert_array_equal(normal.has_pose, [True, False, True])
    metric = replace(found, metric=True)
    assert metric.normalized() is metric


def test_a_file_gives_back_what_was_saved(tmp_path: Path) -> None:
    found = reconstruction()
    found.save(tmp_path / "found.npz")
    again = Reconstruction.load(tmp_path / "found.npz")
    for field in fields(Reconstruction):
        expected, got = getattr(found, field.name), getattr(again, field.name)
        if isinstance(expected, np.ndarray):
            np.testing.assert_array_equal(got, expected)
            assert got.dtype == expected.dtype
        else:
            assert got == expected
    assert [path.name for path in tmp_path.iterdir()] == ["found.npz"]
    (tmp_path / "found.npz").write_bytes(b"PK")
    with pytest.raises(MapError, match="damaged"):
        Reconstruction.load(tmp_path / "found.npz")


def test_a_depth_is_the_way_along_the_cameras_axis_and_grows_with_the_scale() -> None:
    found = reconstruction()
    found.T_world_cam[0, :3, :3] = ((0, 0, -1), (1, 0, 0), (0, -1, 0))  # looks along -x
    found.T_world_cam[0, :3, 3] = 4, 0, 0
    np.testing.assert_allclose(found.depths(), [4, 3, 5, 7])
    larger = found.scaled(3.0)
    np.testing.assert_allclose(larger.depths(), [12, 9, 15, 21])
    np.testing.assert_allclose(larger.T_world_cam[0, :3, :3], found.T_world_cam[0, :3, :3])
    np.testing.assert_allclose(found.points[2], (0, 1, 7))
    assert np.median(found.normalized().depths()) == pytest.approx(2.0)
