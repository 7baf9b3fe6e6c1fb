"""The benchmark's absent words: which names count as absent, and its rows."""

from __future__ import annotations

import json
from itertools import pairwise
from pathlib import Path

import pytest
from benchmark import absent_words, report
from benchmark.processes import PartFailed
from small_captures import data_folder, models_folder, thin_house


def test_names_of_what_is_there_in_any_words_are_not_absent() -> None:
    names = ["sofa", "couch", "futon", "folding chair", "mug", "banana", "wine bottle", "seating"]
    assert absent_words.absent_names(names, ["chair", "sofa", "tableware"]) == ["banana", "wine bottle"]


def test_some_of_many_names_are_spread_evenly() -> None:
    many = [f"{n:04d}" for n in range(1000)]
    chosen = absent_words.spread(many)
    assert len(chosen) == len(set(chosen)) == absent_words.ABSENT
    assert {int(b) - int(a) for a, b in pairwise(chosen)} == {5}
    assert absent_words.spread(many[:50]) == many[:50]


def test_a_scene_holds_what_its_truth_holds() -> None:
    bedroom = absent_words.scene_classes(data_folder() / "house" / "bedroom")
    assert "bed" in bedroom
    assert "refrigerator" not in bedroom
    assert absent_words.scene_classes(data_folder() / "7scenes-kitchen") == ()
    assert absent_words.scene_classes(Path("nowhere")) == ()


def test_a_map_of_class_images_is_not_asked_in_vain(tmp_path: Path) -> None:
    models_folder()
    bedroom = thin_house(data_folder() / "house" / "bedroom", tmp_path, 24)
    row = {"capture": "bedroom", **absent_words.measure_absent_words(str(bedroom))}
    assert json.loads(json.dumps(row)) == row
    assert row["absent"] == 200
    assert row["all_absent"] > 1000
    assert row["absent_answered"] <= 0.05
    assert row["present_found"] > 0.9
    table = report.write_markdown(
        {"rows": [], "measurements": {"absent_words": [row, {"capture": "x", "error": "no names"}]}}
    )
    assert (
        f"| bedroom, `labels`: 200 absent names that return a region | {row['absent_answered']:.1%} | ≤ 5 % |" in table
    )
    assert "not available, no names" in table


def test_a_capture_of_which_nothing_is_known_is_reported(tmp_path: Path) -> None:
    models_folder()
    with pytest.raises(PartFailed, match="add them to SEEN"):
        absent_words.measure_absent_words(str(tmp_path))
