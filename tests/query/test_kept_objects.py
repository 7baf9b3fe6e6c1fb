"""Objects that a map keeps: those that would be found, in every map with words, and in the answers to words."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
import yaml

import freeocc3d
from freeocc3d.core.errors import MapError
from freeocc3d.editing.adaptive_voxels import refine_where_needed
from freeocc3d.editing.box_refinement import enclose_region, refine_box
from freeocc3d.editing.scaling import scale_map
from freeocc3d.query.objects import finding
from freeocc3d.query.objects.finding import find_objects
from freeocc3d.query.objects.object import Object
from freeocc3d.query.scan_map import Map, load_map


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> Path:
    settings = {
        "capture": {"stop": 8, "color_focal": 1.0, "synthetic": {"width": 160, "height": 120}},
        "language": {"encoder": "labels"},
    }
    return freeocc3d.reconstruct("builtin:room", tmp_path_factory.mktemp("maps") / "room", settings).path


@pytest.fixture
def copy(saved: Path, tmp_path: Path) -> Path:
    return shutil.copytree(saved, tmp_path / "map")


def require_equal(kept: list[Object], found: list[Object]) -> None:
    assert len(kept) == len(found) > 1
    for a, b in zip(kept, found, strict=True):
        assert (a.names, a.keyframes, a.confidence) == (b.names, b.keyframes, b.confidence)
        assert (a.volume_m3, a.box.yaw) == (b.volume_m3, b.box.yaw)
        for one, other in ((a.rows, b.rows), (a.feature, b.feature), (a.centroid, b.centroid)):
            np.testing.assert_array_equal(one, other)
        np.testing.assert_array_equal(a.box.extent, b.box.extent)
        np.testing.assert_array_equal(a.box.T_map_box, b.box.T_map_box)


def forbid(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*asked: object) -> None:
        raise AssertionError("the objects are found again")

    monkeypatch.setattr(finding, "find_objects", fail)


def test_a_map_keeps_the_objects_that_would_be_found(saved: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    loaded = load_map(saved)
    found = find_objects(loaded)
    forbid(monkeypatch)
    assert loaded.manifest.objects == len(found)
    assert loaded.report["seconds"]["objects"] > 0
    require_equal(loaded.objects(), found)


def test_a_word_finds_whole_objects_first_where_the_map_keeps_them(saved: Path) -> None:
    loaded = load_map(saved)
    word = loaded.objects()[0].name
    first, whole = loaded.query(word), loaded.query(word, objects=True)
    assert [region.number for region in first.regions] == [region.number for region in whole.regions]
    assert first.regions[0].number is not None
    assert all(region.number is None for region in loaded.query(word, objects=False).regions)
    assert len(loaded.query(word, top_k=1).regions) == 1
    (of_class,) = loaded.query_classes([word])
    assert all(region.number is None for region in of_class.regions)


def without_objects(path: Path) -> None:
    content = yaml.safe_load((path / "map.yaml").read_text())
    del content["objects"], content["files"]["objects.npz"], content["checksums"]["objects.npz"]
    (path / "map.yaml").write_text(yaml.safe_dump(content))
    (path / "objects.npz").unlink()


def test_an_earlier_map_finds_its_objects_when_asked_and_answers_with_voxels(saved: Path, copy: Path) -> None:
    without_objects(copy)
    kept, earlier = load_map(saved), load_map(copy)
    word = kept.objects()[0].name
    assert all(region.number is None for region in earlier.query(word).regions)
    require_equal(kept.objects(), earlier.objects())
    assert earlier.query(word, objects=True).regions[0].number is not None


def test_maps_made_of_a_map_keep_their_own_objects_or_none(saved: Path, tmp_path: Path) -> None:
    loaded = load_map(saved)
    region = loaded.query(loaded.objects()[0].name).regions[0]
    made = {
        "scaled": lambda path: scale_map(loaded, 1.5, "length", path),
        "refined": lambda path: refine_where_needed(loaded, loaded.manifest.voxel_size_m / 2, path),
    }
    for name, make in made.items():
        other: Map = make(tmp_path / name)
        assert other.manifest.objects
        require_equal(other.objects(), find_objects(other))
    box = refine_box(loaded, enclose_region(region, 0.08), 0.04, tmp_path / "box")
    assert box.manifest.objects is None
    assert not (tmp_path / "box" / "objects.npz").exists()


def test_a_map_of_colors_keeps_none(saved: Path, tmp_path: Path) -> None:
    settings = {"capture": {"stop": 4, "color_focal": 1.0, "synthetic": {"width": 80, "height": 60}}}
    colors = freeocc3d.reconstruct("builtin:room", tmp_path / "colors", settings)
    assert colors.manifest.objects is None
    assert "objects.npz" not in colors.manifest.files


def test_damaged_objects_are_named(copy: Path) -> None:
    whole = (copy / "objects.npz").read_bytes()
    (copy / "objects.npz").write_bytes(whole[:-1] + bytes([whole[-1] ^ 1]))
    with pytest.raises(MapError, match=r"objects\.npz is damaged: its checksum"):
        load_map(copy).objects()
    (copy / "objects.npz").unlink()
    with pytest.raises(MapError, match=r"lacks its file objects\.npz"):
        load_map(copy)
