"""Occupied voxels against the truth, and the file that holds the truth."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers import data_folder

from freeocc3d.errors import FreeOccError
from freeocc3d.evaluation.iou import load_ground_truth, occupancy_iou


def test_scores_of_a_case_counted_by_hand() -> None:
    labels = np.array([1, 2, 3, 4, 0, 0, 255, 255], np.uint8).reshape(2, 2, 2)
    occupied = np.array([1, 1, 1, 0, 1, 0, 1, 0], bool).reshape(2, 2, 2)
    score = occupancy_iou(labels, occupied)
    assert score.iou == pytest.approx(3 / 5)
    assert score.precision == pytest.approx(3 / 4)
    assert score.recall == pytest.approx(3 / 4)
    assert score.voxels == 6


def test_precision_and_recall_are_not_exchanged() -> None:
    labels = np.array([1, 1, 1, 0], np.uint8).reshape(1, 2, 2)
    score = occupancy_iou(labels, np.array([1, 0, 0, 0], bool).reshape(1, 2, 2))
    assert (score.precision, score.recall) == (1.0, pytest.approx(1 / 3))


def test_what_was_not_observed_does_not_count() -> None:
    rng = np.random.default_rng(0)
    labels = rng.choice(np.array([0, 1, 255], np.uint8), (6, 7, 8))
    occupied = rng.random((6, 7, 8)) < 0.5
    flipped = occupied ^ (labels == 255)
    assert occupancy_iou(labels, flipped) == occupancy_iou(labels, occupied)


def test_perfect_empty_and_opposite_predictions() -> None:
    labels = np.array([0, 1, 5, 0], np.uint8).reshape(2, 2, 1)
    assert occupancy_iou(labels, labels > 0).iou == 1.0
    assert occupancy_iou(labels, labels == 0).iou == 0.0
    empty = occupancy_iou(labels, np.zeros((2, 2, 1), bool))
    assert (empty.iou, empty.precision, empty.recall) == (0.0, 0.0, 0.0)


def test_a_prediction_on_another_lattice_is_refused() -> None:
    with pytest.raises(FreeOccError, match=r"\(2, 2, 3\)"):
        occupancy_iou(np.zeros((2, 2, 2), np.uint8), np.zeros((2, 2, 3), bool))


def test_voxel_states_are_not_taken_for_a_prediction() -> None:
    with pytest.raises(FreeOccError, match="boolean"):
        occupancy_iou(np.zeros((2, 2, 2), np.uint8), np.full((2, 2, 2), 255, np.uint8))  # type: ignore[arg-type]


def test_a_truth_that_observed_nothing_is_refused() -> None:
    with pytest.raises(FreeOccError, match="observed no voxel"):
        occupancy_iou(np.full((2, 2, 2), 255, np.uint8), np.zeros((2, 2, 2), bool))


def truth(**changes: Any) -> dict[str, Any]:
    """Arrays of a valid ground_truth.npz, some of them replaced."""
    labels = np.array([0, 1, 2, 255], np.uint8).reshape(2, 2, 1)
    classes = np.array(["free", "wall", "floor"])
    return {
        "labels": labels, "origin": np.array([1.0, 2.0, 3.0]), "voxel_size": np.array(0.08), "classes": classes,
    } | changes  # fmt: skip


def test_a_ground_truth_is_read_as_it_was_written(tmp_path: Path) -> None:
    path = tmp_path / "ground_truth.npz"
    np.savez_compressed(path, **truth())
    loaded = load_ground_truth(path)
    np.testing.assert_array_equal(loaded.labels, truth()["labels"])
    assert loaded.origin.tolist() == [1.0, 2.0, 3.0]
    assert loaded.voxel_size == 0.08
    assert loaded.classes == ("free", "wall", "floor")
    assert loaded.shape == (2, 2, 1)


@pytest.mark.parametrize("name", ["labels", "origin", "voxel_size", "classes"])
def test_a_missing_array_is_named(tmp_path: Path, name: str) -> None:
    arrays = truth()
    del arrays[name]
    np.savez(tmp_path / "gt.npz", **arrays)
    with pytest.raises(FreeOccError, match=f"no '{name}'"):
        load_ground_truth(tmp_path / "gt.npz")


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("labels", np.zeros((2, 2), np.uint8)),
        ("labels", np.zeros((2, 2, 2), np.float32)),
        ("labels", np.full((2, 2, 2), 3, np.uint8)),
        ("origin", np.zeros(2)),
        ("origin", np.array([0.0, np.nan, 0.0])),
        ("voxel_size", np.array(0.0)),
        ("voxel_size", np.array(np.inf)),
        ("voxel_size", np.array([0.08])),
        ("classes", np.array([1, 2, 3])),
    ],
)
def test_an_unusable_array_is_named(tmp_path: Path, name: str, value: Any) -> None:
    np.savez(tmp_path / "gt.npz", **truth(**{name: value}))
    with pytest.raises(FreeOccError, match=f"'{name}' of"):
        load_ground_truth(tmp_path / "gt.npz")


def test_nothing_is_unpickled(tmp_path: Path) -> None:
    np.savez(tmp_path / "gt.npz", **truth(classes=np.array(["free", None], dtype=object)))
    with pytest.raises(FreeOccError, match=r"damaged or not an \.npz file of plain arrays"):
        load_ground_truth(tmp_path / "gt.npz")


def test_files_that_are_no_ground_truth_are_refused(tmp_path: Path) -> None:
    with pytest.raises(FreeOccError, match="Cannot read"):
        load_ground_truth(tmp_path / "absent.npz")
    with pytest.raises(FreeOccError, match="Cannot read"):
        load_ground_truth(tmp_path)
    np.save(tmp_path / "one.npy", np.zeros(3))
    with pytest.raises(FreeOccError, match="single array"):
        load_ground_truth(tmp_path / "one.npy")
    np.savez(tmp_path / "gt.npz", **truth())
    whole = (tmp_path / "gt.npz").read_bytes()
    for name, content in {"empty": b"", "text": b"labels: none\n", "half": whole[: len(whole) // 2]}.items():
        (tmp_path / name).write_bytes(content)
        with pytest.raises(FreeOccError, match="damaged"):
            load_ground_truth(tmp_path / name)


@pytest.mark.parametrize("capture", ["7scenes-kitchen", "house/living", "house/bedroom"])
def test_the_ground_truths_of_the_captures_are_read(capture: str) -> None:
    loaded = load_ground_truth(data_folder() / capture / "ground_truth.npz")
    assert loaded.voxel_size == 0.08
    assert occupancy_iou(loaded.labels, (loaded.labels != 0) & (loaded.labels != 255)).iou == 1.0
