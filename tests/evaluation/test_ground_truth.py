"""The file that holds the truth about a scene, and its masks."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from small_captures import data_folder

from freeocc3d.core.errors import ExportError, FreeOccError
from freeocc3d.evaluation.ground_truth import load_ground_truth, save_ground_truth
from freeocc3d.evaluation.true_occupancy import GroundTruth


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
    with pytest.raises(FreeOccError, match="damaged"):
        load_ground_truth(tmp_path / "gt.npz")


def test_files_that_are_no_ground_truth_are_refused(tmp_path: Path) -> None:
    with pytest.raises(FreeOccError, match="Cannot read"):
        load_ground_truth(tmp_path / "absent.npz")
    with pytest.raises(FreeOccError, match="Cannot read"):
        load_ground_truth(tmp_path)
    np.save(tmp_path / "one.npy", np.zeros(3))
    with pytest.raises(FreeOccError, match="damaged or not"):
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
    assert set(loaded.masks()) == {"label"}
    assert 0 < loaded.masks()["label"].mean() < 1


def test_what_is_saved_is_read_again_and_nothing_is_replaced_unasked(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    labels = rng.choice(np.array([0, 1, 2, 255], np.uint8), (4, 5, 6))
    saved = GroundTruth(labels, np.array([0.1, -2.0, 3.0]), 0.04, ("free", "wall", "floor"), labels % 2 == 0)
    save_ground_truth(saved, tmp_path / "gt.npz")
    loaded = load_ground_truth(tmp_path / "gt.npz")
    np.testing.assert_array_equal(loaded.labels, saved.labels)
    np.testing.assert_array_equal(loaded.frames_mask, saved.frames_mask)
    assert (loaded.voxel_size, loaded.classes) == (0.04, saved.classes)
    with pytest.raises(ExportError, match="exists"):
        save_ground_truth(saved, tmp_path / "gt.npz")


def test_masks_hold_only_what_is_known() -> None:
    labels = np.array([0, 1, 255, 255], np.uint8).reshape(4, 1, 1)
    frames = np.array([True, False, True, False]).reshape(4, 1, 1)
    masks = GroundTruth(labels, np.zeros(3), 0.1, ("free", "wall"), frames).masks()
    assert masks["label"].ravel().tolist() == [True, True, False, False]
    assert masks["frames"].ravel().tolist() == [True, False, False, False]


def test_voxel_centers_are_half_a_voxel_from_the_corner() -> None:
    truth = GroundTruth(np.zeros((2, 3, 4), np.uint8), np.array([1.0, 2.0, 3.0]), 0.1, ("free",))
    np.testing.assert_allclose(truth.centers()[1, 2, 3], (1.15, 2.25, 3.35))
