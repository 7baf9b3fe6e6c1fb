"""Whether the color and depth of a scan match: a correct rendered scan, an altered one, and real ones."""

from types import SimpleNamespace

import numpy as np
import pytest
from small_captures import data_folder, write_seven_scenes

from freeocc3d.capture import open_capture
from freeocc3d.capture.base import Capture, Options
from freeocc3d.capture.focal_correction import Reregistered
from freeocc3d.core.errors import ConfigError
from freeocc3d.core.types import Intrinsics
from freeocc3d.tracking.rgbd import focal_calibration
from freeocc3d.tracking.rgbd.alignment_views import AlignmentView
from freeocc3d.tracking.rgbd.measured_pairs import MeasuredPair, measure_pairs
from freeocc3d.tracking.rgbd.orb_features import OrbFeatures


def estimate_color_focal(capture: Capture, frames: range) -> float:
    return focal_calibration.estimate_color_focal(measure_pairs(capture, frames))


ROOM = {"synthetic": {"frames": 120, "width": 320, "height": 240, "noise": True}}


@pytest.fixture(scope="module")
def room() -> Capture:
    return open_capture("builtin:room", None, ROOM)


def test_a_wrong_focal_length_is_found(room) -> None:
    """Color seen as by a camera with 1 / ratio of the focal length has to be brought back by ratio."""
    wrong = Reregistered(room, 1 / 1.1)
    assert estimate_color_focal(wrong, range(len(room))) == pytest.approx(1.1, abs=0.015)


@pytest.mark.parametrize(("name", "ratio"), [("7scenes-kitchen", 0.903), ("house/bedroom", 1.0), ("house/living", 1.0)])
def test_real_captures(name, ratio) -> None:
    capture = open_capture(data_folder() / name)
    assert estimate_color_focal(capture, range(len(capture))) == pytest.approx(ratio, abs=0.012 if ratio != 1 else 0)


def test_too_little_to_tell_changes_nothing(tmp_path) -> None:
    capture = open_capture(write_seven_scenes(tmp_path / "scan", 5))
    assert estimate_color_focal(capture, range(5)) == 1.0


def test_depth_poses_and_names_stay_and_color_moves(room) -> None:
    changed = Reregistered(room, 0.9)
    plain, moved = room[3], changed[3]
    np.testing.assert_array_equal(plain.depth_m, moved.depth_m)
    assert plain.intrinsics == moved.intrinsics
    np.testing.assert_array_equal(room.pose(3), changed.pose(3))
    assert changed.name(3) == room.name(3)
    assert np.abs(plain.color.astype(int) - moved.color).mean() > 1
    labels, before = changed.labels(3), room.labels(3)
    assert labels is not None
    assert set(np.unique(labels)) <= set(np.unique(before))
    # The pixel in the middle shows the same; one off the middle what was seen nearer to it.
    K = plain.intrinsics
    v, u = round(K.cy), round(K.cx + 60)
    np.testing.assert_allclose(moved.color[v, u], plain.color[v, round(K.cx + 54)], atol=40)


def test_a_focal_length_out_of_range_is_refused(tmp_path) -> None:
    with pytest.raises(ConfigError, match="color_focal"):
        open_capture(write_seven_scenes(tmp_path / "scan", 2), Options(color_focal=3.0))


def decided(monkeypatch, best: float, gain: float = 0.5, pairs: int = 8, matches: int = 63) -> float:
    """The ratio if the error falls by a share to a minimum at ``best``, for pairs of so many matches each."""
    rows = np.zeros((matches, 2), np.int64)
    pair = MeasuredPair(0, 1, None, None, np.eye(4), rows)  # type: ignore[arg-type]

    def error(pairs, ratio) -> float:
        deep = 1 - gain
        return deep + (1 - deep) * (np.log(ratio / best) / np.log(1 / best)) ** 2

    monkeypatch.setattr(focal_calibration, "_error", error)
    return focal_calibration.estimate_color_focal([pair] * pairs)


@pytest.mark.parametrize("best", [0.85, 0.9, 1.1, 1.2])
def test_the_ratio_is_where_the_error_is_least(monkeypatch, best: float) -> None:
    assert decided(monkeypatch, best) == pytest.approx(best, rel=1e-6)


@pytest.mark.parametrize(
    ("changes", "found"),
    [
        ({"gain": 0.16}, True),
        ({"gain": 0.14}, False),
        ({"pairs": 7, "matches": 99}, False),
        ({"matches": 62}, False),  # 496 matches in all
        ({"best": 1.016}, True),
        ({"best": 1.014}, False),
        ({"best": 0.986}, False),
        ({"best": 0.984}, True),
        ({"best": 0.79}, False),  # beyond what is tried
        ({"best": 1.26}, False),
    ],
)
def test_a_ratio_must_stand_out(monkeypatch, changes: dict, found: bool) -> None:
    assert (decided(monkeypatch, **{"best": 1.1, **changes}) != 1.0) == found


@pytest.mark.parametrize(("best", "out"), [(0.79, True), (1.26, True), (1.1, False), (1.0, False)])
def test_an_error_that_falls_up_to_the_end_is_told(monkeypatch, best: float, out: bool) -> None:
    rows = np.zeros((63, 2), np.int64)
    pair = MeasuredPair(0, 1, None, None, np.eye(4), rows)  # type: ignore[arg-type]

    def error(pairs, ratio) -> float:
        return 1.0 if best == 1 else 0.5 + (np.log(ratio / best) / np.log(1 / best)) ** 2 / 2

    monkeypatch.setattr(focal_calibration, "_error", error)
    assert focal_calibration.fit_color_focal([pair] * 8).out_of_range == out


def test_the_error_saturates_and_counts_matches_with_a_depth() -> None:
    """Features at a depth of 2 m, 3 pixels off in the target: a half; and one without depth, which does not count."""
    camera = Intrinsics(160, 120, 100.0, 100.0, 79.5, 59.5)
    v, u = np.mgrid[:120, :160]
    points = np.float32(np.stack(((u - 79.5) / 50, (v - 59.5) / 50, np.full(u.shape, 2.0)), axis=-1))
    points[:, 100:] = 0
    normals = np.float32(np.broadcast_to((0.0, 0.0, 1.0), points.shape))
    view = AlignmentView(camera, points, normals, np.ones((120, 160), np.float32), ())
    pixels = np.float32([(40, 30), (60, 90), (130, 20)])
    nothing = np.zeros((3, 32), np.uint8)
    source = SimpleNamespace(camera=camera, view=view, features=OrbFeatures(pixels, nothing))
    for off, ratio, wanted in (((3.0, 0.0), 1.0, 0.5), ((0.0, -6.0), 1.0, 0.8), ((0.0, 0.0), 1.0, 0.0)):
        target = SimpleNamespace(features=OrbFeatures(pixels + np.float32(off), nothing))
        rows = np.array([(0, 0), (1, 1), (2, 2)])
        found = focal_calibration._error([MeasuredPair(0, 1, source, target, np.eye(4), rows)], ratio)
        assert found == pytest.approx(wanted, abs=1e-4)
    moved = np.eye(4)
    moved[0, 3] = 0.2  # 10 pixels at 2 m
    target = SimpleNamespace(features=OrbFeatures(pixels + np.float32((10, 0)), nothing))
    assert focal_calibration._error(
        [MeasuredPair(0, 1, source, target, moved, np.array([(0, 0)]))], 1.0
    ) == pytest.approx(0, abs=1e-5)
    assert focal_calibration._error([MeasuredPair(0, 1, source, target, moved, np.array([(0, 0)]))], 1.3) > 0.3
    assert focal_calibration._error([], 1.0) == 0
