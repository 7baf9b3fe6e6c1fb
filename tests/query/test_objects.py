"""Objects of a map: which voxels, names, places and keyframes they have."""

from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
import worded_voxels as cells

import freeocc3d
from freeocc3d.query.objects import surface_instances
from freeocc3d.query.objects.finding import average_features, name_features
from freeocc3d.query.objects.instances import divide_into_instances
from freeocc3d.query.scan_map import load_map


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    settings = {
        "capture": {"stop": 8, "color_focal": 1.0, "synthetic": {"width": 160, "height": 120}},
        "language": {"encoder": "labels"},
    }
    return freeocc3d.reconstruct("builtin:room", tmp_path_factory.mktemp("maps") / "room", settings).path


def test_objects_are_separate_things_with_names_and_places(saved) -> None:
    loaded = load_map(saved)
    objects = loaded.objects(names=2)
    assert {"floor", "wall", "ceiling"}.isdisjoint(thing.name for thing in objects)
    assert len(objects) > 1
    rows = np.concatenate([thing.rows for thing in objects])
    assert len(np.unique(rows)) == len(rows)
    centers = loaded.occupancy.centers(loaded.occupancy.occupied_voxels())
    frames = set(loaded.trajectory.keyframes.tolist())
    for thing in objects:
        assert len(thing.names) == 2
        np.testing.assert_allclose(thing.centroid, centers[thing.rows].mean(axis=0))
        assert np.isclose(np.linalg.norm(thing.feature), 1)
        assert {view.frame for view in thing.keyframes} <= frames
    assert all(a.confidence >= b.confidence for a, b in pairwise(objects))


def test_an_object_has_the_mean_feature_of_its_voxels_and_its_nearest_name() -> None:
    cup, coffee = cells.feature(CUP=1), cells.feature(COFFEE=1)
    occupancy = cells.occupancy(cells.box((0, 0, 0), (2, 2, 1), cup) | cells.box((5, 0, 0), (7, 2, 1), coffee))
    instance = (occupancy.occupied_voxels()[:, 0] > 3).astype(int)
    features, agreement = average_features(occupancy, np.arange(8), instance)
    np.testing.assert_allclose(features, [cup, coffee])
    np.testing.assert_allclose(agreement, 1)
    features = np.concatenate((features, np.zeros_like(features[:1])))
    names = name_features(features, cells.WORDS, cells.CLASSES[1:], 2)
    assert [own[0][0] for own in names[:2]] == ["cup", "coffee table"]
    assert names[2] == ()


def test_classes_divide_a_map_only_where_its_views_agree_about_them(monkeypatch) -> None:
    monkeypatch.setattr(surface_instances, "divide_surface", lambda scan_map, *_: np.array([7, 5, -1]))
    coffee, wall = cells.feature(COFFEE=1), cells.feature(WALL=1)
    table, behind = cells.box((0, 0, 0), (4, 4, 1), coffee), cells.box((0, 5, 0), (4, 6, 4), wall)
    for cup in (cells.feature(CUP=1), cells.feature(CUP=1, COFFEE=1)):
        occupancy = cells.occupancy(table | cells.box((0, 0, 1), (2, 2, 5), cup) | behind)
        scan_map = SimpleNamespace(occupancy=occupancy, text_encoder=cells.WORDS, up=np.array((0.0, 0.0, 1.0)))
        instance = divide_into_instances(scan_map)
        if cup.max() < 1:  # a third of the voxels may be either
            assert instance.tolist() == [1, 0, -1]
        else:
            _, y, z = occupancy.occupied_voxels().T
            assert set(instance[y == 5]) == {-1}
            assert {*instance[(y < 5) & (z == 0)]} | {*instance[(y < 5) & (z > 0)]} == {0, 1}
            assert len(set(instance[(y < 5) & (z > 0)])) == 1
