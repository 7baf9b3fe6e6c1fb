"""Plans for ROS, read by map_server's own rules on a room without symmetry."""

import json

import numpy as np
import pytest
from exported_maps import Z_UP, map_of, map_server, room

from freeocc3d.core.errors import ConfigError, ExportError
from freeocc3d.export import export_map
from freeocc3d.export.export_frames import place_voxels


def test_every_pixel_of_a_room_without_symmetry(tmp_path) -> None:
    occupancy, expected = room()
    scan_map = map_of(occupancy, Z_UP)
    export_map(scan_map, "nav2", tmp_path / "map.yaml", {"max_height": 1.7})
    data, resolution, origin = map_server(tmp_path / "map.yaml")
    assert resolution == pytest.approx(0.1)
    sampled = place_voxels(scan_map, "gravity").occupancy  # the same lattice shifted by less than half a voxel
    assert sampled.voxel_size == resolution
    for j in range(7):
        for i in range(12):
            center = (-0.33 + (i + 0.5) * 0.1, 2.0 + (j + 0.5) * 0.1)
            column, row = np.floor((np.array(center) + 1e-9 - origin) / resolution).astype(int)
            assert data[row, column] == expected[j, i], (i, j)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["map.pgm", "map.yaml", "map.yaml.json"]
    assert json.loads((tmp_path / "map.yaml.json").read_text())["floor_z_m"] == 0


def test_heights_are_above_the_floor_in_the_first_cameras_frame(tmp_path) -> None:
    occupancy, expected = room()
    scan_map = map_of(occupancy, Z_UP)
    T = np.array([(1.0, 0, 0, 0), (0, 0, 1, 2.3), (0, -1, 0, 1.5), (0, 0, 0, 1)])  # x right, looks along y, at 1.5 m
    scan_map.trajectory.T_world_cam[1] = T
    export_map(scan_map, "nav2", tmp_path / "map.yaml", {"max_height": 1.7, "frame": "start"})
    data, resolution, origin = map_server(tmp_path / "map.yaml")
    x, y = -0.33 + 4.5 * 0.1, 2.0 + 6.5 * 0.1  # of the wall: ahead, and to the right
    column, row = np.floor((np.array((y - 2.3, -x)) - origin) / resolution).astype(int)
    assert data[row, column] == 100
    assert (data == 100).sum() == pytest.approx((expected == 100).sum(), abs=7)
    assert (data == 0).sum() > 50


def test_free_share_and_inflation(tmp_path) -> None:
    occupancy, expected = room()
    scan_map = map_of(occupancy, Z_UP)
    low = {"max_height": 5.0}
    export_map(scan_map, "nav2", tmp_path / "strict.yaml", low)
    export_map(scan_map, "nav2", tmp_path / "any.yaml", {**low, "min_free": 0.0})
    assert (map_server(tmp_path / "strict.yaml")[0] == 0).sum() == 0  # seen up to 1.9 m, which is not half of 5 m
    assert (map_server(tmp_path / "any.yaml")[0] == 0).sum() == (expected == 0).sum() - 1  # the lamp's cell
    export_map(scan_map, "nav2", tmp_path / "wide.yaml", {"max_height": 1.7, "inflation": 0.1})
    wide = map_server(tmp_path / "wide.yaml")[0] == 100
    grown = expected == 100
    grown[1:] |= expected[:-1] == 100
    grown[:-1] |= expected[1:] == 100
    grown[:, 1:] |= expected[:, :-1] == 100
    grown[:, :-1] |= expected[:, 1:] == 100
    np.testing.assert_array_equal(wide, grown)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"frame": "map"}, "must be gravity or start, got 'map'"),
        ({"min_height": 2.0}, r"below 'nav2\.max_height'"),
        ({"min_free": 1.5}, "from 0 to 1"),
        ({"inflation": -1.0}, "from 0 to 1000"),
        ({"inflation": float("nan")}, "inflation"),
    ],
)
def test_bad_options_are_reported(tmp_path, options, message) -> None:
    with pytest.raises(ConfigError, match=message):
        export_map(map_of(room()[0], Z_UP), "nav2", tmp_path / "map.yaml", options)
    assert not list(tmp_path.iterdir())


def test_what_cannot_be_written_is_reported(tmp_path) -> None:
    with pytest.raises(ConfigError, match=r"\.yaml"):
        export_map(map_of(room()[0], Z_UP), "nav2", tmp_path / "map.pgm")
    with pytest.raises(ExportError, match="no plan"):
        export_map(map_of(room()[0], Z_UP), "nav2", tmp_path / "map.yaml", {"min_height": 7.0, "max_height": 8.0})
    assert not list(tmp_path.iterdir())
