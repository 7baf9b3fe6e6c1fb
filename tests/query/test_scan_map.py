"""A map that answers words, classes and pictures, and the places of the answers."""

import numpy as np
import pytest
from msgspec import structs

import freeocc3d
from freeocc3d.query.conditions import Where
from freeocc3d.query.scan_map import load_map
from freeocc3d.storage.manifest import MapScale


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    settings = {"capture": {"stop": 8, "color_focal": 1.0, "synthetic": {"width": 160, "height": 120}}}
    return freeocc3d.reconstruct("builtin:room", tmp_path_factory.mktemp("maps") / "room", settings).path


def test_a_loaded_map_answers_and_keeps_its_parts_together(saved) -> None:
    loaded = load_map(saved)
    occupancy = loaded.occupancy
    assert len(occupancy.features) == len(occupancy.colors) == loaded.manifest.counts.voxels.occupied
    assert len(loaded.gaussians) == len(loaded.gaussian_features) == loaded.manifest.counts.gaussians
    assert loaded.trajectory.has_pose.sum() == 8
    assert loaded.query("red").matched
    assert loaded.labels().max() <= len(loaded.vocabulary)


def test_several_regions_are_placed_at_once_as_one_by_one(saved) -> None:
    loaded = load_map(saved)
    regions = loaded.query("red").regions[:3]
    assert [box.yaw for box in loaded.boxes_of(regions)] == [loaded.box_of(region).yaw for region in regions]
    assert loaded.views_of_each(regions) == [loaded.views_of(region) for region in regions]
    assert loaded.boxes_of([]) == loaded.views_of_each([]) == loaded.stands_of([]) == []


def test_a_class_is_the_voxels_that_are_labeled_so(saved) -> None:
    loaded = load_map(saved)
    labels, everything = loaded.labels(), len(loaded.occupancy.colors)
    for k, result in enumerate(loaded.query_classes(loaded.vocabulary, top_k=everything), start=1):
        rows = [row for region in result.regions for row in region.rows.tolist()]
        assert sorted(rows) == np.flatnonzero(labels == k).tolist()
    (first,) = loaded.query_classes(loaded.vocabulary[:1], where=Where(pick="largest"))
    assert len(first.regions) <= 1


def test_what_a_picture_of_the_room_shows_is_found_again(saved) -> None:
    loaded = load_map(saved)
    asked = loaded.query("red")
    view = loaded.views_of(asked.regions[0])[0]
    row = loaded.trajectory.keyframes.tolist().index(view.frame)
    x0, y0, x1, y1 = view.box
    middle = (x0 + x1) // 2, (y0 + y1) // 2
    found = loaded.query_image(loaded.keyframes[row].color, (*middle, *middle))
    assert found.word == "the picture"
    assert set(asked.regions[0].rows.tolist()) & set(found.regions[0].rows.tolist())


def test_a_place_to_stand_is_reported_where_lengths_are_meters(saved, monkeypatch) -> None:
    loaded = load_map(saved)
    region = loaded.query("red").regions[0]
    monkeypatch.setattr(
        "freeocc3d.query.standing_places.standing_places", lambda _, T, regions: [T[:3, 3]] * len(regions)
    )
    assert loaded.stand_of(region) is not None
    assert len(loaded.stands_of([region, region])) == 2
    monkeypatch.setattr(loaded, "manifest", structs.replace(loaded.manifest, scale=MapScale(metric=False, by="none")))
    assert loaded.stand_of(region) is None
    assert loaded.stands_of([region, region]) == [None, None]


def test_the_package_lists_its_names_before_they_are_used() -> None:
    assert {"Map", "load_map", "reconstruct"} <= set(dir(freeocc3d))
