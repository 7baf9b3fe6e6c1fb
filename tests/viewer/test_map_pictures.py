"""Pictures: written, of the right size, with the right content."""

from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from manifests import tiny_manifest
from scenes import occupancy_of

from freeocc3d.core.errors import ExportError
from freeocc3d.core.types import Trajectory
from freeocc3d.query.oriented_boxes import oriented_boxes
from freeocc3d.query.regions import Region
from freeocc3d.viewer import map_colorings, map_pictures, map_scenes
from freeocc3d.viewer.distinct_colors import distinct_colors
from freeocc3d.viewer.palette import assign_class_colors
from freeocc3d.viewer.scene_rendering import choose_cut_height, turn_lengthwise


def room_map(tmp_path):
    """A floor, two walls, a ceiling and a red block; up is -y."""
    floor = [(x, 20, z) for x in range(24) for z in range(16)]
    ceiling = [(x, 0, z) for x in range(24) for z in range(16)]
    walls = [(0, y, z) for y in range(1, 20) for z in range(16)] + [
        (x, y, 15) for x in range(1, 24) for y in range(1, 20)
    ]
    red = [(x, y, z) for x in (10, 11, 12) for y in (17, 18, 19) for z in (6, 7, 8)]
    voxels = [*floor, *ceiling, *walls, *red]
    colors = [(150, 120, 90)] * len(floor) + [(20, 220, 220)] * len(ceiling) + [(200, 200, 205)] * len(walls)
    occupancy = occupancy_of(voxels, colors=[*colors, *[(215, 20, 20)] * len(red)])
    T = np.tile(np.eye(4), (2, 1, 1))
    T[:, :3, 3] = [(1.0, 1.0, 0.5), (1.5, 1.0, 0.5)]
    T_gravity_map = np.eye(4)
    T_gravity_map[:3, :3] = (1, 0, 0), (0, 0, 1), (0, -1, 0)
    labels = np.where((occupancy.colors == (215, 20, 20)).all(axis=1), 2, 1).astype(np.uint8)
    room = SimpleNamespace(
        path=tmp_path, metric=True, occupancy=occupancy, up=np.array((0.0, -1.0, 0.0)), T_gravity_map=T_gravity_map,
        vocabulary=["wall", "red"],
        labels=lambda: labels,
        trajectory=Trajectory(np.arange(2.0), T, np.array([0, 1], np.int32), np.array(["keyframe"] * 2), np.ones(2)),
        manifest=tiny_manifest(),
    )  # fmt: skip
    room.boxes_of = lambda regions: oriented_boxes(room.occupancy, regions, T_gravity_map)
    return room


def shown(path, color, tolerance=30) -> int:
    image = cv2.imread(str(path))[..., ::-1].astype(int)
    assert image.shape == (900, 1600, 3)
    return int((np.abs(image - color).max(axis=-1) < tolerance).sum())


def test_a_map_picture_looks_into_the_room_from_both_sides(tmp_path) -> None:
    room = room_map(tmp_path)
    map_pictures.write_map_picture(room, tmp_path / "map.png")
    assert shown(tmp_path / "map.png", (215, 20, 20), 60) > 500  # the block on the floor
    assert shown(tmp_path / "map.png", (150, 120, 90)) > 20_000  # the floor
    assert shown(tmp_path / "map.png", (20, 220, 220)) == 0  # the ceiling is cut away
    first = (tmp_path / "map.png").read_bytes()
    map_pictures.write_map_picture(room, tmp_path / "again.png")
    assert (tmp_path / "again.png").read_bytes() == first


def test_walls_lie_along_the_picture_though_the_least_box_around_the_map_does_not() -> None:
    diamond = np.array([(0, 0, 0), (2, 3, 0), (3, 2, 0), (5, 5, 1.0)])
    np.testing.assert_array_equal(turn_lengthwise(np.eye(3), diamond), np.eye(3))
    long = diamond * (1, 2, 1)
    R = turn_lengthwise(np.eye(3), long)
    np.testing.assert_array_equal(np.ptp(long @ R.T, axis=0), (10, 5, 1))
    assert np.linalg.det(R) == 1


def test_a_match_is_in_the_view_however_far_off(tmp_path) -> None:
    far = [(x, 20, 0) for x in (400, 401)]
    floor = [(x, 20, z) for x in range(40) for z in range(40)]
    room = room_map(tmp_path)
    room.occupancy = occupancy_of([*floor, *far], colors=[(150, 120, 90)] * len(floor) + [(20, 20, 20)] * len(far))
    size, voxels = room.occupancy.voxel_size, room.occupancy.occupied_voxels()
    rows = np.flatnonzero(voxels[:, 0] >= 400)
    corner = room.occupancy.origin + voxels[rows].min(axis=0) * size
    region = Region(1.0, 1.0, corner + size, corner, corner + size * np.array((2, 1, 1)), 2 * size**3, rows)
    result = SimpleNamespace(word="far", regions=[region])
    map_pictures.write_query_picture(room, [result], tmp_path / "far.png")
    view = cv2.imread(str(tmp_path / "far.png"))[56:-56, :800, ::-1].astype(int)
    assert (np.abs(view - distinct_colors(1)[0]).max(axis=-1) < 40).any()


def test_by_class_and_height(tmp_path) -> None:
    room = room_map(tmp_path)
    map_pictures.write_map_picture(room, tmp_path / "class.png", by="class")
    assert shown(tmp_path / "class.png", assign_class_colors(["red"])[1], 45) > 500
    map_pictures.write_map_picture(room, tmp_path / "height.png", by="height")
    assert shown(tmp_path / "height.png", (68, 1, 84), 40) > 10_000  # the floor has viridis' darkest color
    with pytest.raises(ExportError, match="rgb, class or height"):
        map_pictures.write_map_picture(room, tmp_path / "x.png", by="color")


def test_a_query_picture_shows_matches_strongly_and_nothing_else(tmp_path) -> None:
    room = room_map(tmp_path)
    rows = np.flatnonzero(room.labels() == 2)
    box = np.array((1.0, 1.7, 0.6))
    region = Region(0.9, 0.9, box + 0.15, box, box + 0.3, 0.027, rows)
    found = SimpleNamespace(word="red", regions=[region])
    nothing = SimpleNamespace(word="unicorn", regions=[])
    map_pictures.write_query_picture(room, [found], tmp_path / "found.png")
    map_pictures.write_query_picture(room, [nothing], tmp_path / "nothing.png")
    legend = 16 * 17
    assert shown(tmp_path / "found.png", distinct_colors(1)[0], 40) > legend + 500
    assert shown(tmp_path / "nothing.png", distinct_colors(1)[0], 40) <= 1.2 * legend


def test_an_empty_map_and_an_unwritable_place_are_reported(tmp_path) -> None:
    room = room_map(tmp_path)
    with pytest.raises(ExportError, match="Cannot write"):
        map_pictures.write_map_picture(room, tmp_path / "missing" / "map.png")
    with pytest.raises(ExportError, match=r"map\.png in place of"):
        map_pictures.write_map_picture(room, tmp_path / "map.jpg")
    room.occupancy = occupancy_of([])
    with pytest.raises(ExportError, match="no occupied voxels"):
        map_pictures.write_map_picture(room, tmp_path / "map.png")
    assert list(tmp_path.iterdir()) == []


def test_a_match_above_the_cut_is_drawn(tmp_path, monkeypatch) -> None:
    room = room_map(tmp_path)
    height = room.occupancy.centers(room.occupancy.occupied_voxels()) @ room.up
    below = height <= choose_cut_height(height, room.occupancy.voxel_size)
    above = np.flatnonzero(~below)[:40]
    monkeypatch.setattr(map_scenes, "_corners", lambda box: np.zeros((8, 3)))

    def strong(rows) -> int:
        """Pixels of the voxels: boxes are drawn as points."""
        region = Region(0.7, 0.9, np.zeros(3), np.zeros(3), np.zeros(3), 0.04, rows)
        found = SimpleNamespace(word="lamp", regions=[region])
        map_pictures.write_query_picture(room, [found], tmp_path / "lamp.png", overwrite=True)
        return shown(tmp_path / "lamp.png", distinct_colors(1)[0], 40) - 16 * 17

    assert strong(above) > 2000
    few = np.flatnonzero(below)[:41]
    assert strong(few) > 500
    assert strong(np.append(few, above)) == strong(few)  # what is mostly below the cut stays cut


def test_the_legend_holds_two_rows_and_counts_what_it_leaves_out() -> None:
    assert map_pictures._placed([300] * 4) == [(0, 16), (0, 336), (0, 656), (0, 976)]
    places = map_pictures._placed([300] * 40)
    assert {row for row, _ in places} == {0, 1}
    assert len(places) == 8
    assert places[-1][1] + 300 <= map_pictures.SIZE[0] - 130
    assert map_pictures._placed([]) == []


def test_the_legend_tells_regions_and_scores() -> None:
    regions = [SimpleNamespace(score=0.914), SimpleNamespace(score=0.3)]
    assert map_colorings._found(SimpleNamespace(word="cup", regions=regions)) == "cup: 2 regions, best 0.91"
    assert map_colorings._found(SimpleNamespace(word="cup", regions=regions[:1])) == "cup: 1 region, 0.91"
    assert map_colorings._found(SimpleNamespace(word="cup", regions=[])) == "cup: no match"
    assert len(map_colorings._found(SimpleNamespace(word="x" * 200, regions=[]))) < 70


@pytest.mark.parametrize("by", ["rgb", "class", "height"])
def test_an_empty_map_is_refused_however_it_is_colored(tmp_path, by) -> None:
    room = room_map(tmp_path)
    room.occupancy = occupancy_of([])
    with pytest.raises(ExportError, match="no occupied voxels"):
        map_pictures.write_map_picture(room, tmp_path / "map.png", by)
