"""Costs of words, read by map_server's own rules and compared with known distances."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
from exported_maps import Z_UP, map_of, map_server, room
from scenes import occupancy_of

from freeocc3d.core.errors import ConfigError, ExportError
from freeocc3d.export import export_map
from freeocc3d.export.export_frames import place_voxels
from freeocc3d.export.keepout_masks import Avoided, compute_cost_map, parse_avoided


def asked(occupancy, regions, **notes):
    """A map whose words are found in voxels: word -> masks of the occupied ones, None = not understood."""

    def query_words(words, objects, top_k):
        assert not objects
        assert top_k >= len(occupancy.colors)  # a robot keeps from all of them
        return [
            SimpleNamespace(
                understood="" if regions.get(word, ()) is None else word,
                note=notes.get(word, "" if regions.get(word) else f"Nothing looks like '{word}'."),
                regions=[SimpleNamespace(rows=np.flatnonzero(mask)) for mask in regions.get(word) or ()],
            )
            for word in words
        ]

    scan_map = map_of(occupancy, Z_UP)
    scan_map.query_words = query_words
    return scan_map


def test_costs_of_a_room_by_map_servers_rules(tmp_path) -> None:
    occupancy, expected = room()
    at = occupancy.occupied_voxels()
    table = (at[:, 0] >= 7) & (at[:, 2] == 7)
    halves = [table & (at[:, 0] == 7), table & (at[:, 0] > 7)]
    regions = {"table": halves, "old door": [(at == (4, 2, 1)).all(axis=1)]}
    words = ["table:60%", "old door:0.2", "glass:0.5"]
    notes = export_map(asked(occupancy, regions), "nav2", tmp_path / "map.yaml", {"max_height": 1.7, "avoid": words})
    plain, size, origin = map_server(tmp_path / "map.yaml")
    np.testing.assert_array_equal(plain == 100, expected == 100)
    layers = json.loads((tmp_path / "map.yaml.json").read_text())["avoid"]
    assert [(layer["word"], layer["distance_m"], layer["cost"], layer["matched"]) for layer in layers] == [
        ("table", 0.0, 60, True), ("old door", 0.2, 100, True), ("glass", 0.5, 100, False),
    ]  # fmt: skip
    masks = {}
    for name, file in [(layer["word"], layer["file"]) for layer in layers] + [("all", "map.avoid.yaml")]:
        masks[name], layer_size, layer_origin = map_server(tmp_path / file)
        assert layer_size == size
        np.testing.assert_array_equal(layer_origin, origin)
    on_table = np.zeros_like(expected)
    on_table[4:6, 7:10] = 60
    np.testing.assert_array_equal(masks["table"], on_table)
    y, x = np.mgrid[:7, :12]
    at_door = np.where((x - 4) ** 2 + (y - 2) ** 2 <= 4, 100, 0)
    np.testing.assert_array_equal(masks["old door"], at_door)
    assert (masks["glass"] == 0).all()
    np.testing.assert_array_equal(masks["all"], np.max([masks[layer["word"]] for layer in layers], axis=0))
    assert notes == ["Nothing looks like 'glass'. Its mask map.glass.yaml is empty."]


def test_what_hangs_above_the_robot_costs_nothing(tmp_path) -> None:
    occupancy, _ = room()
    lamp = (occupancy.occupied_voxels() == (10, 1, 18)).all(axis=1)
    scan_map = asked(occupancy, {"lamp": [lamp]})
    notes = export_map(scan_map, "nav2", tmp_path / "map.yaml", {"max_height": 1.5, "avoid": ["lamp:1"]})
    assert (map_server(tmp_path / "map.lamp.yaml")[0] == 0).all()
    assert notes == ["All of 'lamp' lies above the robot's height. Its mask map.lamp.yaml is empty."]


def test_a_word_that_is_not_understood_leaves_nothing(tmp_path) -> None:
    scan_map = asked(room()[0], {"carpt": None})
    with pytest.raises(ExportError, match="Nothing looks like 'carpt'"):
        export_map(scan_map, "nav2", tmp_path / "map.yaml", {"avoid": ["carpt"]})
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("size", [0.04, 0.08])
@pytest.mark.parametrize("cost", [100, 70])
def test_distances_from_a_disc_and_from_beyond_the_plan(size, cost) -> None:
    shape, center, radius, meters = (60, 45), (20.2, 30.7), 6.3, 0.5
    x, y = np.indices((80, 60)) - 10  # the disc is cut off by the plan's upper edge, y = 45
    disc = np.argwhere(np.hypot(x - center[0], y - center[1] - 9) <= radius) - 10
    found = compute_cost_map(disc, shape, size, Avoided("disc", meters, cost))
    i, j = np.indices(shape)
    distance = size * np.sqrt(((np.stack((i, j), -1)[:, :, None] - disc) ** 2).sum(axis=-1).min(axis=-1))
    if cost == 100:
        np.testing.assert_array_equal(found, np.where(distance <= meters, 100, 0))
    else:
        np.testing.assert_allclose(found, cost * np.clip(1 - distance / meters, 0, 1), atol=0.5 + 1e-9)
    # The disc itself, of which cells are a sample: off by no more than a cell.
    analytic = size * (np.hypot(i - center[0], j - center[1] - 9) - radius)
    assert (found[analytic < meters - size] > 0).all() if cost == 100 else found.max() == cost
    assert not found[analytic > meters + size].any()


def test_a_layer_is_where_the_plan_is_whatever_the_lattice(tmp_path) -> None:
    occupancy, _ = room()
    table = (occupancy.occupied_voxels()[:, 0] >= 7) & (occupancy.occupied_voxels()[:, 2] == 7)
    scan_map = asked(occupancy, {"table": [table]}, table="Only a part was understood.")
    notes = export_map(scan_map, "nav2", tmp_path / "map.yaml", {"avoid": ["table"]})
    assert notes == ["Only a part was understood."]
    data, size, origin = map_server(tmp_path / "map.table.yaml")
    there = place_voxels(scan_map, "gravity")
    inside = np.isin(there.rows, np.flatnonzero(table))
    centers = there.occupancy.centers(there.occupancy.occupied_voxels()[inside])[:, :2]
    column, row = np.floor((centers - origin) / size).astype(int).T
    assert (data[row, column] == 100).all()
    assert (data == 100).sum() == len(set(zip(row.tolist(), column.tolist(), strict=True)))


@pytest.mark.parametrize(
    ("entry", "expected"),
    [
        ("carpet", Avoided("carpet")),
        ("dining table : 0.5", Avoided("dining table", 0.5)),
        ("carpet:40%", Avoided("carpet", 0.0, 40)),
        ("plant:1.5:60%", Avoided("plant", 1.5, 60)),
    ],
)
def test_entries_are_words_meters_and_costs(entry, expected) -> None:
    assert parse_avoided([entry]) == [expected]


@pytest.mark.parametrize(
    ("entries", "message"),
    [
        (["glass:near"], "whole costs from 1 to 100; got 'glass:near'"),
        (["glass:-1"], "got 'glass:-1'"),
        (["glass:nan"], "got 'glass:nan'"),
        (["glass:1e9"], "got"),
        (["glass:0%"], "got"),
        (["glass:101%"], "got"),
        (["glass:5.5%"], "got"),
        (["glass:inf%"], "got"),
        (["glass:1:2:3%"], "got"),
        (["glass:50%:1"], "got"),
        ([":0.5"], "got ':0.5'"),
        (["a b", "a_b"], "same file name"),
        (["avoid"], "same file name"),
    ],
)
def test_bad_entries_are_reported(tmp_path, entries, message) -> None:
    with pytest.raises(ConfigError, match=message):
        export_map(map_of(occupancy_of([(0, 0, 0)]), Z_UP), "nav2", tmp_path / "map.yaml", {"avoid": entries})
    assert not list(tmp_path.iterdir())
