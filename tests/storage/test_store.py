"""The map folder: what is saved comes back; what is damaged is told."""

import shutil

import numpy as np
import pytest
import yaml
from scenes import random_gaussians

import freeocc3d
from freeocc3d.core.errors import MapError
from freeocc3d.gaussians.point_cloud import from_point_cloud, read_gaussian_ply, to_point_cloud, write_gaussian_ply
from freeocc3d.query.conditions import Where
from freeocc3d.storage import store
from freeocc3d.storage.keyframes import Keyframes


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    settings = {"capture": {"stop": 8, "synthetic": {"width": 160, "height": 120}}}
    return freeocc3d.reconstruct("builtin:room", tmp_path_factory.mktemp("maps") / "room", settings).path


@pytest.fixture
def copy(saved, tmp_path):
    return shutil.copytree(saved, tmp_path / "map")


def test_a_loaded_map_answers_and_keeps_its_parts_together(saved) -> None:
    loaded = freeocc3d.load_map(saved)
    occupancy = loaded.occupancy
    assert len(occupancy.features) == len(occupancy.colors) == loaded.manifest["counts"]["voxels"]["occupied"]
    assert len(loaded.gaussians) == len(loaded.gaussian_features) == loaded.manifest["counts"]["gaussians"]
    assert loaded.trajectory.has_pose.sum() == 8
    assert loaded.query("red").matched
    assert loaded.labels().max() <= len(loaded.vocabulary)


def test_a_class_is_the_voxels_that_are_labelled_so(saved) -> None:
    loaded = freeocc3d.load_map(saved)
    labels, everything = loaded.labels(), len(loaded.occupancy.colors)
    for k, result in enumerate(loaded.query_classes(loaded.vocabulary, top_k=everything), start=1):
        rows = [row for region in result.regions for row in region.rows.tolist()]
        assert sorted(rows) == np.flatnonzero(labels == k).tolist()
    (first,) = loaded.query_classes(loaded.vocabulary[:1], where=Where(pick="largest"))
    assert len(first.regions) <= 1


def test_what_a_picture_of_the_room_shows_is_found_again(saved) -> None:
    loaded = freeocc3d.load_map(saved)
    asked = loaded.query("red")
    view = loaded.views_of(asked.regions[0])[0]
    row = loaded.trajectory.keyframes.tolist().index(view.frame)
    x0, y0, x1, y1 = view.box
    middle = (x0 + x1) // 2, (y0 + y1) // 2
    found = loaded.query_image(loaded.keyframes[row].color, (*middle, *middle))
    assert found.word == "the picture"
    assert set(asked.regions[0].rows.tolist()) & set(found.regions[0].rows.tolist())


def test_a_place_to_stand_is_told_where_lengths_are_metres(saved, monkeypatch) -> None:
    loaded = freeocc3d.load_map(saved)
    region = loaded.query("red").regions[0]
    monkeypatch.setattr(
        "freeocc3d.query.standing_places.standing_places", lambda _, T, regions: [T[:3, 3]] * len(regions)
    )
    assert loaded.stand_of(region) is not None
    assert len(loaded.standing_places([region, region])) == 2
    loaded.manifest["scale"] = {"metric": False, "by": "unknown", "factor": 1.0}
    assert loaded.stand_of(region) is None
    assert loaded.standing_places([region, region]) == [None, None]


def test_gaussians_survive_the_point_cloud_and_the_file_exactly(tmp_path) -> None:
    g = random_gaussians(50, seed=0)
    write_gaussian_ply(g, tmp_path / "g.ply")
    for again in (from_point_cloud(to_point_cloud(g)), read_gaussian_ply(tmp_path / "g.ply")):
        for name in g.__dataclass_fields__:
            np.testing.assert_array_equal(getattr(again, name), getattr(g, name))
            assert getattr(again, name).dtype == getattr(g, name).dtype


def test_the_point_cloud_shares_memory(tmp_path) -> None:
    g = random_gaussians(5, seed=1)
    cloud = to_point_cloud(g)
    g.scales[2] = 7.0
    assert (cloud.point["scale"].numpy()[2] == 7.0).all()


def test_not_a_map(tmp_path, copy) -> None:
    with pytest.raises(MapError, match="no map folder"):
        store.load_map(tmp_path / "nothing")
    (copy / "map.yaml").unlink()
    with pytest.raises(MapError, match="not a map"):
        store.load_map(copy)


def edit(folder, **changes) -> None:
    manifest = yaml.safe_load((folder / "map.yaml").read_text())
    (folder / "map.yaml").write_text(yaml.safe_dump({**manifest, **changes}))


def test_a_map_from_a_newer_version(copy) -> None:
    edit(copy, format_version=store.FORMAT_VERSION + 1)
    with pytest.raises(MapError, match="upgrade freeocc3d"):
        store.load_map(copy)


@pytest.mark.parametrize("name", ["occupancy.npz", "gaussians.ply", "features.npz", "trajectory.txt", "report.json"])
def test_missing_and_truncated_files_are_named(copy, name) -> None:
    whole = (copy / name).read_bytes()
    (copy / name).write_bytes(whole[: len(whole) // 2])
    with pytest.raises(MapError, match=name):
        store.load_map(copy)
    (copy / name).unlink()
    with pytest.raises(MapError, match=name):
        store.load_map(copy)


@pytest.mark.parametrize("name", ["occupancy.npz", "features.npz"])
def test_damage_that_keeps_the_size_is_told_when_it_is_read(copy, name) -> None:
    data = bytearray((copy / name).read_bytes())
    middle = len(data) // 2
    data[middle : middle + 200] = bytes(b ^ 0x5A for b in data[middle : middle + 200])
    (copy / name).write_bytes(bytes(data))
    loaded = store.load_map(copy)
    with pytest.raises(MapError, match=name):
        _ = (loaded.occupancy, loaded.gaussian_features)


@pytest.mark.parametrize("levels", [31, -1, 0.5, [0]])
def test_levels_that_no_map_has_are_told(copy, levels) -> None:
    with np.load(copy / "occupancy.npz") as file:
        arrays = dict(file)
    levels = np.array(levels) if isinstance(levels, list) else np.full(len(arrays["keys"]), levels)
    np.savez(copy / "occupancy.npz", **arrays, levels=levels.astype(np.uint8) if levels.max() == 31 else levels)
    manifest = yaml.safe_load((copy / "map.yaml").read_text())
    edit(copy, files={**manifest["files"], "occupancy.npz": (copy / "occupancy.npz").stat().st_size})
    with pytest.raises(MapError, match=r"occupancy\.npz is damaged"):
        _ = store.load_map(copy).occupancy


def test_a_damaged_manifest(copy) -> None:
    edit(copy, voxel_size_m="big")
    with pytest.raises(MapError, match="voxel_size_m"):
        store.load_map(copy)
    (copy / "map.yaml").write_text("a: [1, 2")
    with pytest.raises(MapError, match=r"map\.yaml"):
        store.load_map(copy)
    (copy / "map.yaml").write_text("!!python/object/apply:os.system ['true']")
    with pytest.raises(MapError, match=r"map\.yaml"):
        store.load_map(copy)


def test_files_outside_the_folder_are_refused(copy) -> None:
    manifest = yaml.safe_load((copy / "map.yaml").read_text())
    edit(copy, files={**manifest["files"], "../../etc/passwd": 1})
    with pytest.raises(MapError, match="outside"):
        store.load_map(copy)


def test_keyframes_come_back_and_their_damage_is_named(saved, copy) -> None:
    frames = freeocc3d.load_map(saved).keyframes
    assert len(frames) >= 1
    assert frames[0].depth_m.dtype == np.float32
    assert frames[0].color.shape == (120, 160, 3)
    path = next(copy.joinpath("keyframes").glob("*.depth.png"))
    path.write_bytes(b"")
    with pytest.raises(MapError, match=r"depth\.png"):
        _ = list(Keyframes.load(copy / "keyframes"))


def test_names_that_only_one_of_many_keyframes_has_are_left_out(copy, monkeypatch) -> None:
    assert freeocc3d.load_map(copy).scene_words == []
    names = {"sofa": {"count": 3, "keyframes": [0, 3, 6]}, "ghost": {"count": 1, "keyframes": [0]}}
    for keyframes, expected in (([0, 3, 5, 6], ["sofa"]), ([0, 3, 6], ["sofa", "ghost"])):
        edit(copy, vocabulary={"model": "m", "keyframes": keyframes, "names": names})
        loaded = freeocc3d.load_map(copy)
        assert loaded.scene_words == expected
        assert "sofa" not in loaded.vocabulary
        monkeypatch.setattr(type(loaded.text_encoder), "open_vocabulary", True)
        assert loaded.vocabulary == expected
        monkeypatch.undo()


@pytest.mark.parametrize(
    "named", ["sofa", {"names": {}}, {"keyframes": [], "names": ["sofa"]}, {"keyframes": [], "names": {"sofa": 3}}]
)
def test_a_damaged_vocabulary_is_told(copy, named) -> None:
    edit(copy, vocabulary=named)
    with pytest.raises(MapError, match="'vocabulary'"):
        freeocc3d.load_map(copy)


def test_the_gravity_frame_is_saved_or_found_again(copy) -> None:
    saved_frame = store.load_map(copy).T_gravity_map
    manifest = yaml.safe_load((copy / "map.yaml").read_text())
    assert manifest.pop("T_gravity_map") == saved_frame.tolist()
    (copy / "map.yaml").write_text(yaml.safe_dump(manifest))
    found = store.load_map(copy).T_gravity_map
    np.testing.assert_allclose(found, saved_frame, atol=1e-3)
    edit(copy, T_gravity_map=(2 * np.eye(4)).tolist())
    with pytest.raises(MapError, match="T_gravity_map"):
        _ = store.load_map(copy).T_gravity_map
