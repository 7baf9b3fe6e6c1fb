"""Class files: the scored classes, and the map from other names to them."""

from pathlib import Path

import numpy as np
import pytest
from small_captures import data_folder

from freeocc3d.core.errors import FreeOccError
from freeocc3d.evaluation.ground_truth import load_ground_truth
from freeocc3d.evaluation.scored_classes import EMBODIEDOCC, SHARED, load_class_map, map_each_to_itself
from freeocc3d.evaluation.true_occupancy import GroundTruth

EXAMPLE = Path(__file__).parents[2] / "configs" / "classes" / "house_to_embodiedocc.yaml"


def truth(labels: list[int], classes: tuple[str, ...]) -> GroundTruth:
    return GroundTruth(np.array(labels, np.uint8).reshape(-1, 1, 1), np.zeros(3), 0.08, classes)


def write(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


def test_names_map_to_scored_classes_and_to_nothing(tmp_path: Path) -> None:
    path = write(tmp_path / "c.yaml", "classes: [floor, chair]\nmap:\n  Carpet: floor\n  stool: chair\n  lamp: null\n")
    classes = load_class_map(path)
    assert classes.classes == ("floor", "chair")
    assert set(classes.words) == {"floor", "chair", "carpet", "stool"}
    mapped = classes.apply(truth([0, 1, 2, 3, 4, 255], ("free", "lamp", "carpet", "Floor", "stool")), "c.yaml")
    assert mapped.labels.ravel().tolist() == [0, 255, 1, 1, 2, 255]
    assert mapped.classes == ("free", "floor", "chair")


def test_a_class_that_the_file_does_not_know_is_named(tmp_path: Path) -> None:
    classes = load_class_map(write(tmp_path / "c.txt", "floor\n\nchair\n"))
    with pytest.raises(FreeOccError, match=r"'vase'.*add each to its 'map'"):
        classes.apply(truth([1, 2], ("free", "floor", "vase")), "c.txt")
    # A name that the truth lists but does not hold needs no entry.
    assert classes.apply(truth([1], ("free", "floor", "vase")), "c.txt").labels.ravel().tolist() == [1]


def test_every_class_stands_for_itself_without_a_file() -> None:
    original = truth([0, 1, 2, 255], ("free", "wall", "sofa"))
    mapped = map_each_to_itself(original.classes).apply(original, "")
    np.testing.assert_array_equal(mapped.labels, original.labels)
    assert mapped.classes == original.classes


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("classes: [floor\n", "not valid YAML"),
        ("names: [floor]\n", "must hold 'classes'"),
        ("classes: floor\n", "list of names"),
        ("classes: [floor, 3]\n", "list of names"),
        ("classes: [no, floor]\n", "list of names"),
        ("classes: []\n", "list of names"),
        ("classes: [floor, Floor]\n", "different names"),
        ("classes: [floor]\nmap: {carpet: rug}\n", "'rug', which is not one of its classes"),
        ("classes: [floor]\nmap: [carpet]\n", "'map' of"),
        ("3\n", "must hold 'classes'"),
    ],
)
def test_files_of_another_form_are_refused_in_a_sentence(tmp_path: Path, text: str, said: str) -> None:
    with pytest.raises(FreeOccError, match=said) as error:
        load_class_map(write(tmp_path / "c.yaml", text))
    assert "\n" not in str(error.value)


def test_an_absent_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(FreeOccError, match="no such file"):
        load_class_map(tmp_path / "absent.yaml")


def test_the_shipped_example_maps_all_classes_of_the_house() -> None:
    classes = load_class_map(EXAMPLE)
    assert classes.classes == EMBODIEDOCC
    assert SHARED == ("ceiling", "floor", "wall", "window", "chair", "bed", "sofa", "table")
    for name in ("house/bedroom", "house/living"):
        original = load_ground_truth(data_folder() / name / "ground_truth.npz")
        mapped = classes.apply(original, str(EXAMPLE))
        np.testing.assert_array_equal((mapped.labels > 0) & (mapped.labels < 255), original.labels % 255 > 0)
        assert set(original.classes[1:]) <= set(classes.labels)


@pytest.mark.parametrize(("count", "fits"), [(254, True), (255, False)])
def test_as_many_classes_as_labels_of_a_byte_leave(tmp_path: Path, count: int, fits: bool) -> None:
    """0 is free and 255 unknown."""
    path = write(tmp_path / "c.txt", "".join(f"thing {n}\n" for n in range(count)))
    if fits:
        classes = load_class_map(path)
        assert classes.classes[-1] == "thing 253"
        return
    with pytest.raises(FreeOccError, match="at most 254 different names"):
        load_class_map(path)
