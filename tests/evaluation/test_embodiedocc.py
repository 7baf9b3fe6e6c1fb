"""Published ground-truth packages, on small files of the same structure."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from embodiedocc_packages import CORNER, SHAPE, centers, one_sentence, package, write_package

from freeocc3d.core.errors import FreeOccError
from freeocc3d.evaluation.embodiedocc import (
    EMBODIEDOCC_CLASSES,
    find_package,
    load_frames_mask,
    load_global_package,
    read_split,
)


@pytest.mark.parametrize("protocol", [2, 4, 5])
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_a_global_package_is_read(tmp_path: Path, protocol: int, dtype: Any) -> None:
    mask = np.ones(SHAPE, bool)
    mask[2, 3, 1] = False
    content = package(global_pts=centers().astype(dtype), global_mask=mask)
    truth = load_global_package(write_package(tmp_path / "scene.pkl", content, protocol))
    expected = content["global_labels"]  # whatever the global mask says
    assert truth.labels.dtype == np.uint8
    np.testing.assert_array_equal(truth.labels, expected)
    assert truth.voxel_size == 0.08
    np.testing.assert_allclose(truth.origin, CORNER, atol=1e-6)
    np.testing.assert_allclose(truth.centers(), content["global_pts"], atol=1e-6)
    assert truth.classes == EMBODIEDOCC_CLASSES
    assert truth.frames_mask is None
    assert np.asarray(truth.labels).flags.writeable


def test_flat_arrays_and_plain_lists_give_the_same(tmp_path: Path) -> None:
    whole = package()
    flat = package(
        scene_dim=list(SHAPE),
        global_labels=whole["global_labels"].ravel().astype(np.float32),
        global_pts=whole["global_pts"].reshape(-1, 3),
        global_mask=whole["global_mask"].ravel().astype(np.uint8),
        valid_img_paths=None,
    )
    one = load_global_package(write_package(tmp_path / "one.pkl", whole))
    two = load_global_package(write_package(tmp_path / "two.pkl", flat))
    np.testing.assert_array_equal(one.labels, two.labels)
    np.testing.assert_array_equal(one.origin, two.origin)


def test_a_grid_of_one_layer_has_a_voxel_size(tmp_path: Path) -> None:
    shape = (5, 1, 1)
    content = package(
        scene_dim=shape, global_labels=np.zeros(shape, int), global_mask=np.ones(shape), global_pts=centers(shape)
    )
    truth = load_global_package(write_package(tmp_path / "a.pkl", content))
    np.testing.assert_allclose(truth.origin, CORNER, atol=1e-9)
    point = package(scene_dim=[1] * 3, global_labels=np.zeros(1, int), global_mask=None, global_pts=np.zeros((1, 3)))
    with pytest.raises(FreeOccError, match="is a single point"):
        load_global_package(write_package(tmp_path / "a.pkl", point))


def test_the_size_of_a_long_float32_grid_does_not_drift(tmp_path: Path) -> None:
    shape = (220, 2, 2)
    points = (centers(shape) + 500.0).astype(np.float32)
    content = package(
        scene_dim=shape, global_labels=np.zeros(shape, int), global_mask=np.ones(shape), global_pts=points
    )
    truth = load_global_package(write_package(tmp_path / "a.pkl", content))
    assert truth.voxel_size == pytest.approx(0.08, abs=1e-6)
    assert np.abs(truth.centers() - points).max() < 4e-4


def bent(axis: int) -> np.ndarray:
    points = centers()
    points[1, 1, 1, axis] += 0.04
    return points


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"global_pts": centers() * (1, 1, 1.25)}, "centers of cubes.*z 0.1 m"),
        ({"global_pts": centers() * (1.02, 1, 1)}, "centers of cubes"),
        ({"global_pts": centers()[..., [1, 0, 2]]}, "along x, y and z"),
        ({"global_pts": centers()[::-1]}, "along x, y and z"),
        ({"global_pts": centers() * 0}, "along x, y and z|centers of cubes"),
        ({"global_pts": centers().transpose(2, 1, 0, 3).reshape(-1, 3)}, "along x, y and z"),
        ({"global_pts": bent(0)}, "must be a regular grid"),
        ({"global_pts": bent(2)}, "must be a regular grid"),
        ({"global_pts": centers() * np.nan}, "must be finite"),
        ({"global_pts": centers() + np.inf}, "must be finite"),
        ({"global_pts": centers() * 1e307}, "must be finite"),
        ({"global_pts": centers().astype(int)}, r"must be points \(3, 4, 2, 3\)"),
        ({"global_pts": centers((3, 4, 3))}, r"must be points \(3, 4, 2, 3\)"),
        ({"global_pts": None}, "has no 'global_pts'; it holds scene_dim, global_labels"),
        ({"global_mask": None, "global_labels": None, "a\n\x1b[2J" * 99: 1}, "has no 'global_labels'"),
        ({"global_pts": [1, 2]}, "must be an array, got a list"),
        ({"global_labels": np.zeros((4, 3, 2), int)}, r"'global_labels'.*must be numbers of shape \(3, 4, 2\)"),
        ({"global_labels": np.full(SHAPE, 256)}, "whole numbers from 0 to 255"),
        ({"global_labels": np.full(SHAPE, -1)}, "whole numbers from 0 to 255"),
        ({"global_labels": np.full(SHAPE, 1.5)}, "whole numbers from 0 to 255"),
        ({"global_labels": np.full(SHAPE, np.nan)}, "whole numbers from 0 to 255"),
        ({"global_labels": np.full(SHAPE, 12)}, "hold class 12, but only 11 classes have names.*--classes"),
        ({"scene_dim": [3, 4, 0]}, "'scene_dim'.*three counts"),
        ({"scene_dim": [3, 4]}, "'scene_dim'.*three numbers"),
        ({"scene_dim": np.array([3.0, 4.0, np.inf])}, "three finite numbers"),
        ({"scene_dim": (10**400, 1, 1)}, "scene_dim"),
        ({"valid_img_paths": [1]}, "'valid_img_paths'.*list of paths"),
        ({"classes": "wall"}, "'classes'.*list of class names"),
    ],
)  # fmt: skip
def test_what_is_no_package_is_reported(tmp_path: Path, changes: dict[str, Any], message: str) -> None:
    with pytest.raises(FreeOccError, match=message) as error:
        load_global_package(write_package(tmp_path / "scene.pkl", package(**changes)))
    assert one_sentence(error)
    assert "scene.pkl" in str(error.value)


def test_class_names_are_given_or_brought(tmp_path: Path) -> None:
    names = tuple(f"thing {k}" for k in range(44))
    labels = (np.arange(24).reshape(SHAPE) + 20).astype(np.uint8)
    bare = write_package(tmp_path / "bare.pkl", package(global_labels=labels))
    assert load_global_package(bare, ("free", *names)).classes == ("free", *names)
    few = write_package(tmp_path / "few.pkl", package())
    assert load_global_package(few, ("free", *names)).classes == EMBODIEDOCC_CLASSES
    with pytest.raises(FreeOccError, match=r"class 43, but only 42 .*--classes"):
        load_global_package(bare, ("free", *names[:42]))
    for key, brought in (("classes", list(names)), ("class_names", np.array(("empty", *names)))):
        truth = load_global_package(
            write_package(tmp_path / f"{key}.pkl", package(global_labels=labels, **{key: brought}))
        )
        assert truth.classes[1:] == names


def data_set(folder: Path, masks: dict[str, Any], **changes: Any) -> Path:
    """A data set of one scene, with a mask per "split/index"."""
    for place, mask in masks.items():
        split, index = place.split("/")
        frame = {"local_label": np.zeros((60, 60, 36), np.uint8), "mask_in_global": mask}
        write_package(folder / "streme_occ_new_package" / split / f"scene0000_00_{index}_new.pkl", frame)
    paths = [f"/x/{place.split('/')[1]}.jpg" for place in masks]
    content = package(**{"valid_img_paths": paths} | changes)
    return write_package(folder / "global_occ_package" / "scene0000_00.pkl", content)


def test_the_frames_masks_are_united_whatever_their_form(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    masks = rng.random((4, *SHAPE)) < 0.2
    forms = {
        "train/00001": masks[0], "train/00003": masks[1].ravel(), "test/00002": np.flatnonzero(masks[2]),
        "val/00010": masks[3].astype(np.float32),
    }  # fmt: skip
    truth = load_global_package(data_set(tmp_path / "one", forms))
    assert truth.frames_mask is not None
    np.testing.assert_array_equal(truth.frames_mask, masks.any(axis=0))
    backwards = load_global_package(data_set(tmp_path / "two", dict(reversed(forms.items()))))
    np.testing.assert_array_equal(truth.frames_mask, backwards.frames_mask)
    known = (truth.labels != 255) & masks.any(axis=0)
    np.testing.assert_array_equal(truth.masks()["frames"], known)


def test_frames_of_other_scenes_and_unlisted_ones_do_not_count(tmp_path: Path) -> None:
    full, one = np.ones(SHAPE, bool), np.zeros(SHAPE, bool)
    one[1, 2, 1] = True
    path = data_set(tmp_path, {"train/00001": one})
    folder = tmp_path / "streme_occ_new_package"
    for stranger in ("scene0000_001_00001", "scene0000_00_1_00001", "scene0000_01_00001", "scene0000_00_00002"):
        write_package(folder / "train" / f"{stranger}_new.pkl", {"mask_in_global": full})
    np.testing.assert_array_equal(load_global_package(path).frames_mask, one)
    np.testing.assert_array_equal(load_frames_mask(folder, "scene0000_00", SHAPE), full)
    assert load_frames_mask(folder, "scene0000_02", SHAPE) is None
    assert load_frames_mask(folder, "scene0000_0?", SHAPE) is None
    assert load_frames_mask(tmp_path / "none", "scene0000_00", SHAPE) is None


def test_missing_frames_are_reported(tmp_path: Path) -> None:
    path = data_set(tmp_path, {"train/00001": np.ones(SHAPE, bool)}, valid_img_paths=["x/00001.jpg", "x/00004.jpg"])
    with pytest.raises(FreeOccError, match="lacks 1 of the 2 frames of scene0000_00, the first 00004") as error:
        load_global_package(path)
    assert one_sentence(error)


@pytest.mark.parametrize(
    "mask",
    [
        np.ones((4, 3, 2), bool), np.array([0, 24]), np.array([-1]), np.full(SHAPE, 0.5), np.full(24, 30),
        np.ones((5, 3), int), np.array(["a"]), np.array([0.0, 2.0]),
    ],
)  # fmt: skip
def test_masks_that_do_not_fit_are_refused(tmp_path: Path, mask: np.ndarray) -> None:
    with pytest.raises(FreeOccError, match=r"'mask_in_global' of .*scene0000_00_00001_new.pkl is neither") as error:
        load_global_package(data_set(tmp_path, {"train/00001": mask}))
    assert one_sentence(error)


def test_a_split_names_each_scene_once_in_its_order(tmp_path: Path) -> None:
    lines = [
        "# ScanNet-mini", "", "scene0416_01", "scene0006_02_00012", "  scene0416_01  # again",
        "gathered_data/scene0089_00/00007.pkl", "scene0006_02/00001", "room0", "office-3",
    ]  # fmt: skip
    expected = ["scene0416_01", "scene0006_02", "scene0089_00", "room0", "office-3"]
    (tmp_path / "split.txt").write_text("\r\n".join(lines))
    assert read_split(tmp_path / "split.txt") == expected
    (tmp_path / "split.json").write_text(json.dumps(expected + ["scene0006_02_00002"]))
    assert read_split(tmp_path / "split.json") == expected


@pytest.mark.parametrize(
    ("file", "text", "message"),
    [
        ("a.txt", "", "names no scene"), ("a.txt", "# only\n", "names no scene"),
        ("a.txt", "scene12", "'scene12' of the split .* names no scene"), ("a.txt", "scene0000_001", "names no scene"),
        ("a.txt", "../etc/passwd", "names no scene"), ("a.txt", "two words", "names no scene"),
        ("a.json", "{}", "list of scene names"), ("a.json", "[1]", "list of scene names"),
        ("a.json", "[", "damaged"), ("a.json", "[" * 100_000, "damaged"), ("a.json", "[]", "names no scene"),
    ],
)  # fmt: skip
def test_a_split_of_another_form_is_refused(tmp_path: Path, file: str, text: str, message: str) -> None:
    (tmp_path / file).write_text(text)
    with pytest.raises(FreeOccError, match=message) as error:
        read_split(tmp_path / file)
    assert one_sentence(error)


def test_a_split_that_cannot_be_read(tmp_path: Path) -> None:
    with pytest.raises(FreeOccError, match=r"Cannot read the split .*: no such file"):
        read_split(tmp_path / "none.txt")
    (tmp_path / "a.txt").write_bytes(b"\xff\xfe\x00s")
    with pytest.raises(FreeOccError, match="damaged"):
        read_split(tmp_path / "a.txt")


def test_packages_are_found(tmp_path: Path) -> None:
    beside = write_package(tmp_path / "room0.pkl", {})
    inside = write_package(tmp_path / "global_occ_package" / "scene0000_00.pkl", {})
    assert find_package(tmp_path, "room0") == beside
    assert find_package(tmp_path, "scene0000_00") == inside
    assert find_package(inside.parent, "scene0000_00") == inside
    with pytest.raises(FreeOccError, match=r"no package of scene0000_01.*the nearest are scene0000_00"):
        find_package(tmp_path, "scene0000_01")
    with pytest.raises(FreeOccError, match="it has no packages"):
        find_package(tmp_path / "none", "room0")


@pytest.mark.parametrize("scene", ["../room0", "/etc/passwd", "", "..", "a/b", ".hidden", "a\\b", "room0\n", "a\0b"])
def test_a_scene_cannot_lie_outside_the_folder(tmp_path: Path, scene: str) -> None:
    write_package(tmp_path / "room0.pkl", {})
    with pytest.raises(FreeOccError, match="is not the name of a scene"):
        find_package(tmp_path / "inside", scene)
