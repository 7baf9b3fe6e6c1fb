"""Saved maps: what is saved reads back, and damage is reported."""

import shutil

import numpy as np
import pytest
import yaml

import freeocc3d
from freeocc3d.core.errors import MapError
from freeocc3d.storage.keyframes import Keyframes
from freeocc3d.storage.manifest import FORMAT_VERSION
from freeocc3d.storage.saved_map import SavedMap


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    settings = {"capture": {"stop": 8, "color_focal": 1.0, "synthetic": {"width": 160, "height": 120}}}
    return freeocc3d.reconstruct("builtin:room", tmp_path_factory.mktemp("maps") / "room", settings).path


@pytest.fixture
def copy(saved, tmp_path):
    return shutil.copytree(saved, tmp_path / "map")


def test_not_a_map(tmp_path, copy) -> None:
    with pytest.raises(MapError, match="nothing does not exist"):
        SavedMap.open(tmp_path / "nothing")
    (copy / "map.yaml").unlink()
    with pytest.raises(MapError, match="not a map"):
        SavedMap.open(copy)


def edit(folder, **changes) -> None:
    manifest = yaml.safe_load((folder / "map.yaml").read_text())
    (folder / "map.yaml").write_text(yaml.safe_dump({**manifest, **changes}))


def test_a_map_from_a_newer_version(copy) -> None:
    edit(copy, format_version=FORMAT_VERSION + 1)
    with pytest.raises(MapError, match="upgrade freeocc3d"):
        SavedMap.open(copy)


@pytest.mark.parametrize("name", ["occupancy.npz", "gaussians.ply", "features.npz", "trajectory.txt", "report.json"])
def test_missing_and_truncated_files_are_named(copy, name) -> None:
    whole = (copy / name).read_bytes()
    (copy / name).write_bytes(whole[: len(whole) // 2])
    with pytest.raises(MapError, match=name):
        SavedMap.open(copy)
    (copy / name).unlink()
    with pytest.raises(MapError, match=name):
        SavedMap.open(copy)


@pytest.mark.parametrize("name", ["occupancy.npz", "features.npz"])
def test_damage_that_keeps_the_size_is_reported_when_it_is_read(copy, name) -> None:
    data = bytearray((copy / name).read_bytes())
    middle = len(data) // 2
    data[middle : middle + 200] = bytes(b ^ 0x5A for b in data[middle : middle + 200])
    (copy / name).write_bytes(bytes(data))
    loaded = SavedMap.open(copy)
    with pytest.raises(MapError, match=name):
        _ = (loaded.occupancy, loaded.gaussian_features)


@pytest.mark.parametrize("levels", [31, -1, 0.5, [0]])
def test_levels_that_no_map_has_are_reported(copy, levels) -> None:
    with np.load(copy / "occupancy.npz") as file:
        arrays = dict(file)
    levels = np.array(levels) if isinstance(levels, list) else np.full(len(arrays["keys"]), levels)
    np.savez(copy / "occupancy.npz", **arrays, levels=levels.astype(np.uint8) if levels.max() == 31 else levels)
    manifest = yaml.safe_load((copy / "map.yaml").read_text())
    edit(copy, files={**manifest["files"], "occupancy.npz": (copy / "occupancy.npz").stat().st_size})
    with pytest.raises(MapError, match=r"occupancy\.npz is damaged"):
        _ = SavedMap.open(copy).occupancy


def test_a_damaged_manifest(copy) -> None:
    edit(copy, voxel_size_m="big")
    with pytest.raises(MapError, match="voxel_size_m"):
        SavedMap.open(copy)
    (copy / "map.yaml").write_text("a: [1, 2")
    with pytest.raises(MapError, match=r"map\.yaml"):
        SavedMap.open(copy)
    (copy / "map.yaml").write_text("!!python/object/apply:os.system ['true']")
    with pytest.raises(MapError, match=r"map\.yaml"):
        SavedMap.open(copy)


@pytest.mark.parametrize("state", [None, "red", [], {}])
def test_a_damaged_state_of_the_encoder_is_reported(copy, state) -> None:
    edit(copy, encoder={"name": "labels", "state": state})
    with pytest.raises(MapError, match=r"map\.yaml is damaged: 'encoder\.state'"):
        _ = SavedMap.open(copy).text_encoder


def test_a_manifest_with_other_keyframes_than_the_folder_is_reported(copy) -> None:
    edit(copy, keyframes=[])
    with pytest.raises(MapError, match="list different keyframes"):
        _ = SavedMap.open(copy).keyframes


def test_files_outside_the_folder_are_refused(copy) -> None:
    manifest = yaml.safe_load((copy / "map.yaml").read_text())
    edit(copy, files={**manifest["files"], "../../etc/passwd": 1})
    with pytest.raises(MapError, match="outside"):
        SavedMap.open(copy)


def test_keyframes_come_back_and_their_damage_is_named(saved, copy) -> None:
    frames = SavedMap.open(saved).keyframes
    assert len(frames) >= 1
    assert frames[0].depth_m.dtype == np.float32
    assert frames[0].color.shape == (120, 160, 3)
    path = next(copy.joinpath("keyframes").glob("*.depth.png"))
    path.write_bytes(b"")
    with pytest.raises(MapError, match=r"depth\.png"):
        _ = list(Keyframes.load(copy / "keyframes"))


def test_names_that_only_one_of_many_keyframes_has_are_left_out(copy, monkeypatch) -> None:
    assert SavedMap.open(copy).scene_words == []
    names = {"sofa": {"count": 3, "keyframes": [0, 3, 6]}, "ghost": {"count": 1, "keyframes": [0]}}
    for keyframes, expected in (([0, 3, 5, 6], ["sofa"]), ([0, 3, 6], ["sofa", "ghost"])):
        edit(copy, vocabulary={"model": "m", "keyframes": keyframes, "names": names})
        loaded = SavedMap.open(copy)
        assert loaded.scene_words == expected
        assert "sofa" not in loaded.vocabulary
        monkeypatch.setattr(type(loaded.text_encoder), "open_vocabulary", True)
        assert loaded.vocabulary == expected
        monkeypatch.undo()


@pytest.mark.parametrize(
    "named", ["sofa", {"names": {}}, {"keyframes": [], "names": ["sofa"]}, {"keyframes": [], "names": {"sofa": 3}}]
)
def test_a_damaged_vocabulary_is_reported(copy, named) -> None:
    edit(copy, vocabulary=named)
    with pytest.raises(MapError, match="'vocabulary"):
        SavedMap.open(copy)


def test_the_gravity_frame_is_saved_or_found_again(copy) -> None:
    saved_frame = SavedMap.open(copy).T_gravity_map
    manifest = yaml.safe_load((copy / "map.yaml").read_text())
    assert manifest.pop("T_gravity_map") == saved_frame.tolist()
    (copy / "map.yaml").write_text(yaml.safe_dump(manifest))
    found = SavedMap.open(copy).T_gravity_map
    np.testing.assert_allclose(found, saved_frame, atol=5e-3)  # from Gaussians, not from depth images
    edit(copy, T_gravity_map=(2 * np.eye(4)).tolist())
    with pytest.raises(MapError, match="T_gravity_map"):
        _ = SavedMap.open(copy).T_gravity_map
