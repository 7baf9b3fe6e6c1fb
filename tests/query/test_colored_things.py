"""Colors beside classes: which chairs a "blue chair" is."""

from __future__ import annotations

import numpy as np
import pytest
from worded_voxels import WORDS, box, feature, occupancy

from freeocc3d.query.colored_things import fit_colors, read_colors, read_only_colors
from freeocc3d.query.word_query import query

RED, BLUE, GRAY = (208, 26, 32), (36, 82, 196), (110, 110, 110)
LEFT, RIGHT, TOUCHING = ((0, 0, 0), (4, 4, 4)), ((10, 0, 0), (14, 4, 4)), ((4, 0, 0), (8, 4, 4))


def painted(*things):
    """A map of boxes of classes with colors, and the color of each voxel's box. things: (corners, class, color)."""
    placed = {voxel: (kind, rgb) for corners, kind, rgb in things for voxel in box(*corners, (kind, rgb))}
    made = occupancy({voxel: feature(**{kind: 1.0}) for voxel, (kind, _) in placed.items()})
    colors = np.array([placed[tuple(voxel)][1] for voxel in made.occupied_voxels().tolist()], np.uint8)
    return made.replace(colors=colors)


def test_things_of_a_class_are_told_apart_by_color() -> None:
    room = painted((LEFT, "SOFA", RED), (RIGHT, "SOFA", BLUE), (((20, 0, 0), (24, 4, 4)), "CUP", BLUE))
    (found,) = query(room, WORDS, ["a blue sofa"])
    assert [np.ptp(region.rows) for region in found.regions] == [63]
    assert (room.colors[found.regions[0].rows] == BLUE).all()
    assert (found.understood, found.note) == ("blue sofa", "")
    assert query(room, WORDS, ["blue couch"])[0].note == "'blue couch' was understood as blue sofa."
    (missing,) = query(room, WORDS, ["green sofa"])
    assert not missing.matched
    assert missing.note == "'sofa' is in this map, but not in green."
    assert not query(room, WORDS, ["blue bathtub"])[0].matched


def test_a_blue_sofa_has_gray_legs_and_a_few_blue_voxels_make_no_sofa_blue() -> None:
    legs, edge = (((10, 0, 0), (14, 4, 1)), ((0, 0, 0), (1, 1, 3)))
    room = painted((LEFT, "SOFA", RED), (RIGHT, "SOFA", BLUE), (legs, "SOFA", GRAY), (edge, "SOFA", BLUE))
    (found,) = query(room, WORDS, ["blue sofa"])
    assert [region.voxels for region in found.regions] == [64]
    room = painted((LEFT, "SOFA", RED), (edge, "SOFA", BLUE))
    assert not query(room, WORDS, ["blue sofa"])[0].matched


def test_a_thing_that_touches_another_is_the_part_of_its_color() -> None:
    third = ((8, 0, 0), (12, 4, 4))
    room = painted((LEFT, "CUP", RED), (TOUCHING, "CUP", BLUE), (third, "CUP", GRAY))
    (region,) = query(room, WORDS, ["red cup"])[0].regions
    np.testing.assert_allclose((region.box_min, region.box_max), ((0, 0, 0), (0.4, 0.4, 0.4)), atol=1e-9)


def test_a_color_alone_is_whatever_has_it() -> None:
    room = painted((LEFT, "SOFA", RED), (RIGHT, "CUP", BLUE))
    for word in ("blue", "something blue", "a light blue thing", "dark blue"):
        found = query(room, WORDS, [word, "sofa"])
        assert [result.word for result in found] == [word, "sofa"]
        assert found[0].matched == ("light" not in word and "dark" not in word), word
        assert all((room.colors[region.rows] == BLUE).all() for region in found[0].regions)


@pytest.mark.parametrize(
    ("phrase", "name", "colors"),
    [
        ("the dark blue chair", "chair", "dark blue"),
        ("black and white picture", "picture", "black, white"),
        ("a small chair", "chair", ""),
        ("orange", "orange", ""),
        ("white thing to sit on", "white thing to sit on", "white"),
    ],
)
def test_the_colors_that_a_phrase_adds(phrase: str, name: str, colors: str) -> None:
    assert read_colors(phrase, name) == colors


def test_what_asks_for_a_color_only() -> None:
    assert read_only_colors("a light-blue thing") == "light blue"
    assert [read_only_colors(phrase) for phrase in ("blue bathtub", "dark", "something", "")] == [""] * 4


def test_a_color_between_two_is_the_nearer_one() -> None:
    between = np.array([(80, 150, 127)], np.uint8)  # 0.77 green, 0.64 turquoise: both reach the threshold
    assert fit_colors(between, "green").tolist() == [True]
    assert fit_colors(between, "turquoise").tolist() == [False]
