"""The objects of a map as a page and a picture."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from labeled_rooms import labeled_room
from msgspec import structs
from test_answer_page import Strict, decoded

from freeocc3d.core.errors import ExportError
from freeocc3d.query.scan_map import Map
from freeocc3d.viewer import objects_page
from freeocc3d.viewer.distinct_colors import distinct_colors
from freeocc3d.viewer.object_pictures import _free_place, draw_objects


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Map:
    return labeled_room(tmp_path_factory)


def test_a_page_has_a_plan_and_an_image_of_each_object(room: Map, tmp_path: Path, monkeypatch) -> None:
    objects = room.objects()
    objects[0] = replace(objects[0], names=(("<b>cup</b>", 0.9), ('"&', 0.1)))
    objects[1] = replace(objects[1], keyframes=())
    relations = room.relations_of(objects)
    shown = list(range(len(objects)))
    objects_page.write_objects_page(room, objects, relations, shown, tmp_path / "o.html")
    text = (tmp_path / "o.html").read_text(encoding="utf-8")
    read = Strict()
    read.feed(text)
    assert read.open == []
    images = [source for source in read.sources if not source.startswith("#")]
    assert all(source.startswith("data:image/") for source in images)
    assert len(images) == 1 + sum(bool(thing.keyframes) for thing in objects)
    assert max(decoded(source).size for source in images[1:]) <= 3 * 320 * 240
    assert "no keyframe shows it" in text
    assert "<b>cup" not in text
    assert all(f'id="{source[1:]}"' in text for source in read.sources if source.startswith("#"))
    with pytest.raises(ExportError, match="--overwrite"):
        objects_page.write_objects_page(room, objects, relations, shown, tmp_path / "o.html")
    monkeypatch.setattr(objects_page, "MOST_IMAGES", 1)
    objects_page.write_objects_page(room, objects, relations, shown[2:], tmp_path / "some.html")
    text = (tmp_path / "some.html").read_text(encoding="utf-8")
    assert text.count("<img") == 2
    assert "no image of more than 1 objects" in text


def test_the_plan_shows_each_object_in_its_color_at_its_place(room: Map) -> None:
    objects = room.objects()
    low = next(row for row, thing in enumerate(objects) if thing.centroid[2] < 1 and len(thing.rows) > 30)
    without, drawn = (
        cv2.imdecode(np.frombuffer(draw_objects(room, objects, shown), np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
        for shown in ([], [low])
    )
    plan = np.s_[60:, :1140]
    changed = np.argwhere((without[plan] != drawn[plan]).any(axis=2))
    assert len(changed)
    hue = drawn[plan][tuple(changed.T)].astype(float).mean(axis=0) - 128
    expected = distinct_colors(len(objects))[low].astype(float) - 128
    assert np.corrcoef(hue, expected)[0, 1] > 0.8
    across, along = np.ptp(changed, axis=0)
    extent = objects[low].box.extent
    assert max(across, along) / max(min(across, along), 1) == pytest.approx(extent[0] / extent[1], rel=0.35)


def test_an_empty_map_is_not_drawn(room: Map, monkeypatch) -> None:
    empty = Map(room.path, structs.replace(room.manifest, objects=None))
    nothing = room.occupancy.replace(
        state=np.zeros_like(room.occupancy.state),
        features=room.occupancy.features[:0],
        colors=room.occupancy.colors[:0],
    )
    monkeypatch.setitem(empty.__dict__, "occupancy", nothing)
    assert empty.relations_of(empty.objects()) == []
    with pytest.raises(ExportError, match="no occupied voxels to draw"):
        draw_objects(empty, [], [])


def test_labels_of_a_plan_do_not_cover_each_other_while_there_is_room() -> None:
    taken = np.zeros((0, 2, 2))
    place = np.array((100.0, 100.0))
    for width in (60, 20, 40, 20, 20):
        label = _free_place(place, np.array((width, 20)), taken)
        assert not ((label[0] < taken[:, 1]) & (label[1] > taken[:, 0])).all(axis=1).any()
        np.testing.assert_array_equal(label[1] - label[0], (width, 20))
        taken = np.concatenate((taken, label[None]))
    everywhere = np.array([[(-1e3, -1e3), (1e3, 1e3)]])
    np.testing.assert_array_equal(_free_place(place, np.array((20, 20)), everywhere).mean(axis=0), place)
