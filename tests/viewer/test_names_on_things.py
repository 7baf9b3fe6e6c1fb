"""Names are written beside their things: none covers another, none leaves the view, none is far away without a line."""

import numpy as np
import pytest

from freeocc3d.viewer.lettering import SMALL, measure_text
from freeocc3d.viewer.names_on_things import NamePlaces, _nearest, _overlaps
from freeocc3d.viewer.scene_rendering import DrawnBox, DrawnScene
from freeocc3d.viewer.view_cameras import aim, aim_around, aim_from, pixels_of

CUBE = np.indices((2, 2, 2)).reshape(3, -1).T - 0.5
RED = (213, 94, 0)


def cubes(middles, names, edge=0.6) -> tuple[DrawnBox, ...]:
    return tuple(DrawnBox(middle + edge * CUBE, RED, name) for middle, name in zip(middles, names, strict=True))


def scene_of(boxes) -> DrawnScene:
    vertices = np.concatenate([box.corners[[0, 1, 3, 2]] for box in boxes])
    quads = np.arange(len(vertices), dtype=np.int32).reshape(-1, 4)
    return DrawnScene(vertices, quads, np.zeros((len(quads), 3), np.uint8), np.zeros((0, 3)), boxes)


@pytest.mark.parametrize("view", ["above", "corner"])
@pytest.mark.parametrize("count", [1, 4, 40])
def test_no_name_covers_another_or_leaves_the_view(view, count) -> None:
    middles = np.random.default_rng(count).uniform(0, 4, (count, 3))
    boxes = cubes(middles, [f"thing number {row}" for row in range(count)])
    camera = aim(scene_of(boxes), view, (800, 600))
    places = NamePlaces(boxes)
    places.choose(camera)
    labels = np.array([label for _, label, _ in places._labels])
    assert len(labels) == count if count < 40 else len(labels) > 15
    assert (_overlaps(labels, labels) * (1 - np.eye(len(labels)))).max() == 0
    assert (labels >= 0).all()
    assert (labels <= (800, 600, 800, 600)).all()


def test_a_name_is_beside_its_thing_and_of_its_color() -> None:
    boxes = cubes([(0, 0, 0), (4, 0, 0), (0, 3, 0)], ["sofa", "", "chair"])
    camera = aim(scene_of(boxes), "above", (800, 600))
    picture = np.full((600, 800, 3), 250, np.uint8)
    places = NamePlaces(boxes)
    places.choose(camera)
    places.write(picture)
    assert [row for row, _, _ in places._labels] == [0, 1]  # the nameless box has none
    drawn = np.argwhere((picture == RED).all(axis=2))[:, ::-1]
    for row in (0, 2):
        middle = pixels_of(boxes[row].corners.mean(axis=0)[None], camera)[0][0]
        reach = np.abs(pixels_of(boxes[row].corners, camera)[0] - middle).max()
        assert np.linalg.norm(drawn - middle, axis=1).min() < reach + 40
    nameless = pixels_of(boxes[1].corners.mean(axis=0)[None], camera)[0][0]
    assert np.linalg.norm(drawn - nameless, axis=1).min() > 100


def test_a_line_joins_a_name_and_a_thing_that_are_apart() -> None:
    label = np.array((100.0, 20.0, 180.0, 40.0))
    square = np.array(((120, 140), (160, 140), (160, 180), (120, 180.0)))
    start, end = _nearest(label, square)
    np.testing.assert_allclose((start, end), ((140, 40), (140, 140)))
    start, end = _nearest(label + (20, 130, 20, 130), square)
    np.testing.assert_array_equal(start, end)


def test_a_name_on_a_thing_that_fills_the_view_is_on_the_thing() -> None:
    boxes = cubes([(0, 3, 0)], ["wall"], edge=5.0)
    camera = aim_from(np.array((0.0, 0.0, 0.0)), np.array((0.0, 3.0, 0.0)), (400, 400))
    places = NamePlaces(boxes)
    places.choose(camera)
    ((_, label, _),) = places._labels
    assert (label > 0).all()
    assert label[2] - label[0] == measure_text("wall", SMALL) + 8


def test_what_is_behind_the_camera_has_no_name() -> None:
    boxes = cubes([(0, -3, 0)], ["wall"])
    places = NamePlaces(boxes)
    places.choose(aim_from(np.array((0.0, 0.0, 0.0)), np.array((0.0, 3.0, 0.0)), (400, 400)))
    assert places._labels == []


def test_names_of_a_turning_scene_do_not_jump_from_side_to_side() -> None:
    boxes = cubes([(0, 0, 0), (2, 0, 0), (0, 2.5, 0)], ["one", "two", "three"])
    places, sides = NamePlaces(boxes), []
    for camera in aim_around(scene_of(boxes), (640, 600), 120):
        places.choose(camera)
        sides.append(list(places._chosen))
    assert (np.diff(sides, axis=0) != 0).any(axis=1).mean() < 0.1
