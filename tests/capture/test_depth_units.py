"""The unit of depth: estimated where nothing states it, doubted where it makes no room."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from small_captures import data_folder, depth_image, write_image, write_scannet, write_seven_scenes

from freeocc3d.capture import Options, open_capture
from freeocc3d.capture.checks.depth_units import sample_depth, settle_depth_unit


def write_room(folder: Path, units_per_meter: float, median_m: float = 2.0, layout=write_scannet) -> Path:
    """Three frames of depths between half and one and a half of the median, of any integer."""
    layout(folder, 3)
    for index in range(3):
        name = f"depth/{index}.png" if layout is write_scannet else f"frame-{index:06d}.depth.png"
        depth = np.linspace(0.5, 1.5, 24 * 32).reshape(24, 32) * median_m * units_per_meter
        write_image(folder / name, depth.round().astype(np.uint16))
    return folder


def test_depth_in_its_own_units_raises_no_warning(tmp_path: Path) -> None:
    assert settle_depth_unit(open_capture(write_seven_scenes(tmp_path, 3))) is None


@pytest.mark.parametrize("units", [4000.0, 5000.0, 6553.5, 10000.0])
def test_a_unit_that_nothing_states_is_estimated_and_all_that_fit_are_named(tmp_path: Path, units: float) -> None:
    capture = open_capture(write_room(tmp_path, units, 3.0))
    notice = settle_depth_unit(capture)
    assert notice is not None
    assert notice.code == "depth-scale-doubtful"
    assert f"{units:g} (" in notice.text
    assert notice.text.count(" m)") >= (units != 10000)
    assert 0.5 < np.median(capture[0].depth_m[capture[0].depth_m > 0]) < 5.0
    assert settle_depth_unit(open_capture(tmp_path, Options(depth_scale=units))) is None


def test_millimeters_that_fit_are_taken_without_a_word(tmp_path: Path) -> None:
    capture = open_capture(write_room(tmp_path, 1000.0))
    assert settle_depth_unit(capture) is None
    assert np.isclose(capture[0].depth_m.max(), 3.0)


def test_multiples_of_five_are_millimeters_times_five(tmp_path: Path) -> None:
    write_room(tmp_path, 5000.0, 0.9)
    for path in sorted((tmp_path / "depth").iterdir()):
        stored = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        write_image(path, stored // 5 * 5)
    capture = open_capture(tmp_path)
    notice = settle_depth_unit(capture)
    assert notice is not None
    assert "read with 5000 (TUM)" in notice.text
    assert np.isclose(capture[0].depth_m.max(), 1.35, atol=2e-3)


@pytest.mark.parametrize("units", [5000.0, 6553.5, 1.0])
def test_a_stated_unit_that_makes_no_room_is_doubted(tmp_path: Path, units: float) -> None:
    write_room(tmp_path, units if units > 1 else 1000.0, layout=write_seven_scenes)
    said = 1000.0 if units > 1 else 1.0
    notice = settle_depth_unit(open_capture(tmp_path, Options(depth_scale=said)))
    assert notice is not None
    assert f"does not look like a room with {said:g} units per meter" in notice.text
    assert f"{units if units > 1 else 1000:g} (" in notice.text


def test_depth_all_beyond_the_range_is_warned_of(tmp_path: Path) -> None:
    notice = settle_depth_unit(open_capture(write_seven_scenes(tmp_path, 3), Options(max_depth=1.0)))
    assert notice is not None
    assert "0% of it lies within capture.max_depth = 1 m" in notice.text


def test_depth_without_any_measurement_is_not_about_units(tmp_path: Path) -> None:
    write_seven_scenes(tmp_path, 1)
    write_image(tmp_path / "frame-000000.depth.png", np.zeros((24, 32), np.uint16))
    capture = open_capture(tmp_path)
    assert not capture[0].depth_m.any()
    notice = settle_depth_unit(capture)
    assert notice is not None
    assert notice.code == "depth-empty"
    assert str(tmp_path) in notice.text
    assert sample_depth(capture) is None


def test_floats_are_meters_or_millimeters(tmp_path: Path) -> None:
    write_scannet(tmp_path, 2)
    for scale, expected in ((1.0, 1.0), (1000.0, 1000.0)):
        for path in (tmp_path / "depth").iterdir():
            path.unlink()
        for index in range(2):
            cv2.imwrite(
                str(tmp_path / "depth" / f"{index}.tiff"), depth_image(index, 1000).astype(np.float32) / 1000 * scale
            )
        capture = open_capture(tmp_path)
        assert (settle_depth_unit(capture) is None) == (scale == 1)
        assert capture.raw_depth(0)[1] == expected  # type: ignore[index]
        assert np.isclose(capture[0].depth_m.max(), 2.0)


@pytest.mark.parametrize("name", ["7scenes-kitchen", "house/living", "house/bedroom"])
def test_real_captures_are_in_the_units_that_they_state(name: str) -> None:
    assert settle_depth_unit(open_capture(data_folder() / name)) is None
