"""Whether the color and depth of a scan match: a correct rendered scan, an altered one, and real ones."""

import numpy as np
import pytest
from small_captures import data_folder, write_seven_scenes

from freeocc3d.capture import open_capture
from freeocc3d.capture.base import Capture, Options
from freeocc3d.capture.focal_correction import Reregistered
from freeocc3d.core.errors import ConfigError
from freeocc3d.tracking.rgbd.focal_calibration import estimate_color_focal

ROOM = {"synthetic": {"frames": 120, "width": 320, "height": 240, "noise": True}}


@pytest.fixture(scope="module")
def room() -> Capture:
    return open_capture("builtin:room", None, ROOM)


def test_a_capture_that_fits_is_left_alone(room) -> None:
    assert estimate_color_focal(room, range(len(room))) == 1.0


@pytest.mark.parametrize("ratio", [0.9, 1.1])
def test_a_wrong_focal_length_is_found(room, ratio) -> None:
    """Color seen as by a camera with 1 / ratio of the focal length has to be brought back by ratio."""
    wrong = Reregistered(room, 1 / ratio)
    found = estimate_color_focal(wrong, range(len(room)))
    assert found == pytest.approx(ratio, abs=0.015)


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
