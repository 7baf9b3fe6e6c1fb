"""What a map says of its own quality, and that it says so where poses or voxels are wrong."""

from __future__ import annotations

import dataclasses
import json

import msgspec
import numpy as np
import pytest
from benchmark.self_check import check_lines, measure_check

from freeocc3d import Map
from freeocc3d.cli.check import check_document, told_lines
from freeocc3d.cli.map_summary import summary_lines
from freeocc3d.core.errors import FrameError
from freeocc3d.core.types import OCCUPIED
from freeocc3d.editing.scaling import scale_map
from freeocc3d.pipeline.map_check import LIMITS, MapCheck, Measure, check_map
from freeocc3d.query.scan_map import load_map
from freeocc3d.storage.manifest import MapScale
from freeocc3d.tracking.view_agreement import Agreement


@pytest.fixture(scope="module")
def checked(room: Map) -> MapCheck:
    return check_map(room)


def measures(found: MapCheck) -> dict[str, Measure]:
    return {measure.name: measure for measure in found.measures}


def test_a_saved_map_has_every_measure(room: Map, checked: MapCheck) -> None:
    told = measures(checked)
    assert list(told) == list(LIMITS)
    assert told["step"].count == len(room.keyframes) - 1
    assert 0.001 < told["step"].value < 0.02  # the built-in room has the noise of a sensor
    assert told["revisit"].value is None  # a short walk that never comes back
    assert any("looked elsewhere" in note for note in checked.notes)
    assert told["psnr_held_out"].value > 15
    assert told["posed"].value == 1
    assert {measure.verdict for measure in told.values()} <= {"good", "fair", ""}


def test_the_run_has_told_the_same(room: Map, checked: MapCheck, monkeypatch: pytest.MonkeyPatch) -> None:
    report, told = room.report["check"], measures(checked)
    assert set(report["measures"]) < set(told)
    for name, said in report["measures"].items():
        value = told[name].value
        assert said["value"] == (value and pytest.approx(value, rel=1e-4)), name
    assert "check" in room.report["seconds"]  # what it takes longer than pictures and files
    assert f"check      {report['verdict']}, depth differs by" in "\n".join(summary_lines(room))
    poor = {**report["measures"]["unmeasured"], "verdict": "poor"}
    changed = {**room.report, "check": {"verdict": "poor", "measures": {"unmeasured": poor}}}
    monkeypatch.setitem(vars(room), "report", changed)
    assert "check      poor (occupied voxels in which no depth ends)\n" in "\n".join(summary_lines(room)) + "\n"


def test_wrong_poses_and_voxels_show(room: Map, checked: MapCheck, monkeypatch: pytest.MonkeyPatch) -> None:
    wrong = load_map(room.path)
    T = wrong.trajectory.T_world_cam.copy()
    T[:, :3, 3] += 0.03 * np.arange(len(T))[:, None] * (0.6, 0.0, 0.8)
    monkeypatch.setitem(vars(wrong), "trajectory", dataclasses.replace(wrong.trajectory, T_world_cam=T))
    occupied = wrong.occupancy.state == OCCUPIED
    free = np.where(occupied, 9, wrong.occupancy.free).astype(np.uint16)
    hits = np.where(occupied, 0, wrong.occupancy.hits).astype(np.uint16)
    monkeypatch.setitem(vars(wrong), "occupancy", wrong.occupancy.replace(free=free, hits=hits))
    found = check_map(wrong)
    told, right = measures(found), measures(checked)
    assert told["step"].value > 2 * right["step"].value
    assert told["seen_through"].value == told["unmeasured"].value == 1
    assert found.verdict == told["seen_through"].verdict == "poor"


class _Unreadable:
    def __getitem__(self, index: int) -> None:
        raise FrameError(f"Frame {index} cannot be read.")


def test_held_out_frames_are_those_that_the_run_used_or_none(room: Map, monkeypatch: pytest.MonkeyPatch) -> None:
    other = load_map(room.path)
    first = room.keyframes[0]
    turned = dataclasses.replace(first, color=first.color[::-1])
    monkeypatch.setitem(vars(other), "capture", dict.fromkeys(range(99), turned))
    assert any("not as the run used them" in note for note in check_map(other).notes)
    monkeypatch.setitem(vars(other), "capture", _Unreadable())
    found = check_map(other)
    assert any("cannot be read" in note for note in found.notes)
    assert measures(found)["psnr_held_out"].value is None


def test_lengths_of_a_scaled_map_are_scaled(room: Map, tmp_path) -> None:
    double = scale_map(room, 2.0, "given", tmp_path / "double")
    for name, said in room.report["check"]["measures"].items():
        wanted = said["value"] and said["value"] * (2 if said["unit"] == "m" else 1)
        assert double.report["check"]["measures"][name]["value"] == wanted


def test_the_benchmark_compares_other_poses_of_the_same_keyframes(room: Map, checked: MapCheck) -> None:
    figures = json.loads(json.dumps(measure_check(str(room.path))))
    told = figures["agreement"]
    assert told["own"]["step_off_m"] == pytest.approx(measures(checked)["step"].value)
    assert told["given"]["step_off_m"] < told["drift 8 cm"]["step_off_m"]
    assert 0 <= figures["share_of_run"] < 1
    # This walk never comes back, so that no line tells of revisits.
    lines = check_lines(figures)
    assert lines[0][0].startswith("  step: ")
    for agreement in told.values():
        agreement |= {"revisit_off_m": 0.01, "revisit_sigmas": 2 * agreement["step_sigmas"]}
    assert "1.00 cm, 2.00 steps" in check_lines(figures)[0][1]


def test_a_map_of_unknown_scale_is_told_in_units(room: Map, checked: MapCheck, monkeypatch: pytest.MonkeyPatch) -> None:
    manifest = msgspec.structs.replace(room.manifest, scale=MapScale(metric=False))
    monkeypatch.setattr(room, "manifest", manifest)
    assert " cm" not in "\n".join(told_lines(room, checked))
    assert " units, " in "\n".join(told_lines(room, checked))
    assert check_document(room, checked)["metric"] is False
    assert " units from one keyframe to the next" in "\n".join(summary_lines(room))


def test_verdicts_follow_the_limits() -> None:
    def verdict(name: str, compared: float | None) -> str:
        return Measure(name, compared, "share", compared, 1).verdict

    for name, (low, high, good, poor) in LIMITS.items():
        assert min(low, high) >= 0
        assert (verdict(name, low), verdict(name, high)) == ("good", "good"), name
        between, beyond = (good + poor) / 2, poor + (poor - good)
        assert (verdict(name, between), verdict(name, beyond), verdict(name, None)) == ("fair", "poor", ""), name
    nothing = MapCheck((Measure("step", None, "m", None, 0),), [], Agreement([], []))
    assert (nothing.verdict, nothing.worst(3)) == ("", [])
    assert nothing.summary()["measures"]["step"] == {"value": None, "unit": "m", "count": 0, "verdict": ""}
