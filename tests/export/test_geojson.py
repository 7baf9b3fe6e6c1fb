"""GeoJSON of the regions that words find."""

import json

import numpy as np
import pytest
from exported_maps import asked, map_of
from scenes import occupancy_of

from freeocc3d.core.errors import ConfigError, ExportError
from freeocc3d.export import export_map, geojson
from freeocc3d.query.regions import Region


def test_an_outline_on_the_floor_with_its_height_and_scores(tmp_path) -> None:
    bar = [(i, 10, 20 + k) for i in range(4) for k in range(2)]  # 0.4 m to the right, 0.2 m deep, 0.1 m high
    scan_map = asked(map_of(occupancy_of(bar)))
    export_map(scan_map, "geojson", tmp_path / "map.geojson")
    told = json.loads((tmp_path / "map.geojson").read_text())
    (feature,) = told["features"]
    ring = np.array(feature["geometry"]["coordinates"][0])
    assert ring[0].tolist() == ring[-1].tolist()
    assert sorted(map(tuple, ring[:-1].tolist())) == [(2.0, -0.4), (2.0, 0.0), (2.2, -0.4), (2.2, 0.0)]
    x, y = ring.T
    assert 0.5 * np.sum(x[:-1] * y[1:] - x[1:] * y[:-1]) == pytest.approx(0.08)  # counter-clockwise
    properties = feature["properties"]
    assert properties["word"] == "cup"
    assert properties["area_m2"] == pytest.approx(0.08)
    assert (properties["height_min_m"], properties["height_max_m"]) == (0.42, 0.52)
    np.testing.assert_allclose(properties["centroid"], (2.1, -0.2, 0.47), atol=1e-6)
    assert (properties["score"], properties["confidence"], properties["volume_m3"]) == (0.8, 0.9, 0.008)
    assert (told["frame"], told["unit"]) == ("gravity", "metre")
    np.testing.assert_allclose(told["T_frame_map"], scan_map.T_gravity_map)


def test_numbers_of_large_and_tiny_regions_keep_four_digits_and_a_milliliter() -> None:
    region = Region(0.12344, 0.98766, np.array((1.23456, -0.5, 0)), np.zeros(3), np.ones(3), 1.2345678, np.arange(1))
    corners = np.stack(np.meshgrid(*[(0.0, 0.12344)] * 3), axis=-1).reshape(-1, 3)
    properties = geojson._feature("cup", region, corners, region.centroid)["properties"]
    assert [properties[name] for name in ("score", "confidence", "volume_m3")] == [0.1234, 0.9877, 1.234568]
    assert properties["centroid"] == [1.2346, -0.5, 0.0]
    assert (properties["height_min_m"], properties["height_max_m"]) == (0.0, 0.1234)
    assert properties["area_m2"] == 0.0151  # 123 mm by 123 mm


def test_words_are_those_asked_for(tmp_path) -> None:
    scan_map = asked(map_of(occupancy_of([(0, 0, 1)])))
    assert export_map(scan_map, "geojson", tmp_path / "map.geojson", {"words": ["cup", "table"]}) == ["no table"]
    assert len(json.loads((tmp_path / "map.geojson").read_text())["features"]) == 1
    assert export_map(scan_map, "geojson", tmp_path / "map.geojson", {"words": ["table"]}, True) == ["no table"]
    assert json.loads((tmp_path / "map.geojson").read_text())["features"] == []
    scan_map.vocabulary = []
    with pytest.raises(ExportError, match="give words"):
        export_map(scan_map, "geojson", tmp_path / "b.geojson")
    with pytest.raises(ConfigError, match="must be gravity or start"):
        export_map(scan_map, "geojson", tmp_path / "b.geojson", {"frame": "map"})


def test_an_outline_has_corners_only() -> None:
    square = np.array([(x, y) for x in range(5) for y in range(3)], float)
    ring, area = geojson.outline(square)
    assert area == 8
    assert len(ring) == 5
