"""Lists of classes, and maps from one taxonomy's classes to another's."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from small_captures import models_folder

from freeocc3d.capture.class_files import read_class_file, read_class_names
from freeocc3d.core.errors import CaptureError
from freeocc3d.evaluation.scored_classes import EMBODIEDOCC, load_class_map

CONFIGS = Path(__file__).parents[2] / "configs" / "classes"


def test_lists_in_every_form(tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text("wall\n\n  night stand \n")
    (tmp_path / "b.json").write_text(json.dumps(["wall", "night stand"]))
    (tmp_path / "c.json").write_text(json.dumps({"classes": ["wall", "night stand"]}))
    for name in ("a.txt", "b.json", "c.json"):
        assert read_class_names(tmp_path / name) == ("wall", "night stand")


@pytest.mark.parametrize(
    ("name", "text", "told"),
    [
        ("a.json", "{", "must hold"),
        ("a.json", '{"names": []}', "must hold"),
        ("a.json", "[" * 100_000, "must hold"),
        ("a.json", '["wall"]', "at least 2"),
        ("a.json", '["wall", 3]', "a list of names"),
        ("a.json", "3", "must hold"),
        ("a.txt", "", "a list of names"),
    ],
)
def test_broken_lists_are_reported(tmp_path: Path, name: str, text: str, told: str) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(CaptureError, match=told):
        read_class_names(tmp_path / name)


def test_what_classes_become(tmp_path: Path) -> None:
    (tmp_path / "map.yaml").write_text("classes: [Furniture, wall]\nmap: {Bed: furniture, void: null, desk: Furniture}")
    found = read_class_file(tmp_path / "map.yaml")
    matrix = found.grouping(("void", "Wall", "bed", "desk"))
    assert found.names == ("Furniture", "wall")
    np.testing.assert_array_equal(matrix, [[0, 0, 1, 1], [0, 1, 0, 0]])


def test_the_shipped_mapping_is_of_the_networks_classes_and_can_be_scored_with() -> None:
    path = CONFIGS / "nyu40_to_embodiedocc.yaml"
    assert load_class_map(path).classes == EMBODIEDOCC
    found = read_class_file(path)
    matrix = found.grouping(read_class_names(models_folder() / "nyu40.txt"))
    assert found.names == EMBODIEDOCC
    np.testing.assert_array_equal(matrix.sum(axis=0), [0] + 40 * [1])
    assert (matrix.sum(axis=1) > 0).all()
