"""The benchmark's present words: what counts as found, and its rows."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from benchmark import present_words, report
from benchmark.processes import find_function
from small_captures import data_folder, thin_house


def test_classes_of_a_real_room_are_found_by_their_names(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(present_words, "COLD_STARTS", 1)
    monkeypatch.setattr(present_words, "run_inside", lambda function, **given: find_function(function)(**given))
    bedroom = thin_house(data_folder() / "house" / "bedroom", tmp_path, 20)
    row = {"capture": "house/bedroom", **present_words.measure_present_words(str(bedroom))}
    assert json.loads(json.dumps(row)) == row
    found = row["classes"]
    assert {"bed", "wall", "floor", "trash can"} <= set(found)
    assert sum(own["iou"] >= present_words.ENOUGH for own in found.values()) >= 0.8 * len(found)
    assert all(own["iou"] <= own["occupied"] for own in found.values())
    assert row["absent"] == ["bathtub", "bicycle"]
    assert row["absent_answered"] == []
    assert set(row["cold_seconds"]) == {"text", "--json", "--json --views"}
    assert 0 < row["loaded_seconds"] <= row["loaded_most_seconds"]
    rows = [row, {"capture": "x", "error": "lost"}]
    table = report.write_markdown({"rows": [], "measurements": {"present_words": rows}})
    assert "| house/bedroom, `labels`: bathtub and bicycle that return a region | 0 | 0 |" in table
    assert "not available, lost" in table


def test_rows_name_what_falls_short() -> None:
    classes = {
        "bed": {"iou": 0.9, "occupied": 0.95},
        "fan": {"iou": 0.3, "occupied": 0.4},
    }
    row = {
        "capture": "room", "classes": classes, "absent": ["bathtub"], "absent_answered": ["bathtub"],
        "cold_seconds": {"text": 0.5}, "loaded_seconds": 0.01, "loaded_most_seconds": 0.02,
        "loaded_processor_seconds": 0.005,
    }  # fmt: skip
    lines = present_words.present_words_lines([row])
    assert lines[0][1] == "1 of 2, 50%; fan: IoU 0.30, 40% of its voxels are occupied"
    assert lines[1] == ("room, `labels`: bathtub that return a region", "1", "0")
    assert lines[2][1] == "10.0, 20.0 ms (5.0 ms processor time)"
    assert lines[3] == ("room, `labels`: cold start, text", "0.50 s", "≤ 1.5 s")
