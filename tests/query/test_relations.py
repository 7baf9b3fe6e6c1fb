"""Relations of objects: small rooms with known answers."""

from __future__ import annotations

import numpy as np
import pytest
from worded_voxels import CLASSES, box, feature, occupancy

from freeocc3d.query.objects.object import Object
from freeocc3d.query.objects.relations import Relation, find_relations
from freeocc3d.query.oriented_boxes import oriented_boxes
from freeocc3d.query.regions import best_regions

Cells = dict[tuple[int, int, int], np.ndarray]
NOTHING = feature()


def solid(low: tuple[int, int, int], high: tuple[int, int, int]) -> Cells:
    return box(low, high, NOTHING)


def related(
    things: dict[str, Cells], walls: Cells | None = None, tilt: float = 0.0, metric: bool = True
) -> dict[str, list[str]]:
    """What each thing is: "on table", "against wall". tilt: radians by which the lattice leans."""
    made = occupancy({**(walls or {}), **{voxel: NOTHING for own in things.values() for voxel in own}})
    row_of = {tuple(voxel): row for row, voxel in enumerate(made.occupied_voxels().tolist())}
    T = np.eye(4)
    T[1:3, 1:3] = ((np.cos(tilt), -np.sin(tilt)), (np.sin(tilt), np.cos(tilt)))
    objects = [_object(made, np.sort([row_of[voxel] for voxel in own]), T) for own in things.values()]
    names = list(things)

    def said(relation: Relation) -> str:
        return f"{relation.kind} {'wall' if relation.other is None else names[relation.other]}"

    found = find_relations(made, objects, T, metric)
    return {name: [said(relation) for relation in own] for name, own in zip(names, found, strict=True)}


def _object(made, rows: np.ndarray, T_gravity_map: np.ndarray) -> Object:
    one = np.ones(len(rows), np.float32)
    (region,) = best_regions(made, rows, np.zeros(len(rows), np.int32), one, one, 1, 0.0, 1)
    (around,) = oriented_boxes(made, [region], T_gravity_map)
    return Object(rows, np.zeros(len(CLASSES) - 1), (), around, region.volume_m3, region.centroid, (), 1.0)


TABLE = solid((0, 0, 6), (12, 8, 7)) | solid((1, 1, 0), (2, 2, 6)) | solid((10, 6, 0), (11, 7, 6))


@pytest.mark.parametrize("tilt", [0.0, 0.02])
def test_a_cup_stands_on_the_table_and_the_table_on_the_carpet(tilt: float) -> None:
    cup, carpet = solid((4, 4, 7), (6, 6, 9)), solid((-2, -2, -1), (14, 10, 0))
    found = related({"cup": cup, "table": TABLE, "carpet": carpet}, tilt=tilt)
    assert found == {"cup": ["on table"], "table": ["on carpet"], "carpet": []}


@pytest.mark.parametrize(("rise", "on"), [(-1, True), (0, True), (1, True), (3, False)])
def test_what_a_pillow_hides_of_its_bed_is_told_by_what_is_around_it(rise: int, on: bool) -> None:
    bed = solid((0, 0, 0), (20, 12, 6))
    seen = {cell: value for cell, value in bed.items() if not (4 <= cell[0] < 10 and 2 <= cell[1] < 7)}
    found = related({"pillow": solid((4, 2, 6 + rise), (10, 7, 8 + rise)), "bed": seen})
    assert ("on bed" in found["pillow"]) == on


def test_a_thing_beside_a_carpet_is_not_on_it() -> None:
    carpet = solid((0, 0, 0), (20, 20, 1))
    assert related({"chair": solid((20, 5, 0), (25, 10, 9)), "carpet": carpet})["chair"] == ["next to carpet"]


@pytest.mark.parametrize(("over", "carried"), [(2, True), (1, False)])
def test_a_quarter_of_the_underside_carries(over: int, carried: bool) -> None:
    plank = solid((12 - over, 0, 7), (18 - over, 4, 8))  # of six columns, so many stand over the table
    assert ("on table" in related({"plank": plank, "table": TABLE})["plank"]) == carried


def test_in_is_enclosed_and_not_only_within_the_box() -> None:
    shelf = solid((0, 0, 0), (10, 4, 12))
    niche = solid((1, 0, 4), (9, 3, 8))  # open in front
    shelf = {cell: value for cell, value in shelf.items() if cell not in niche}
    found = related({"books": solid((3, 0, 4), (6, 2, 7)), "shelf": shelf, "box": solid((2, 0, 12), (6, 3, 14))})
    assert found["books"][0] == "in shelf"
    assert found["box"][0] == "on shelf"
    corner = solid((0, 0, 0), (20, 6, 7)) | solid((0, 0, 0), (6, 20, 7))  # a corner sofa's box holds the coffee table
    assert "in sofa" not in related({"low table": solid((10, 10, 0), (16, 16, 4)), "sofa": corner})["low table"]
    assert related({"chair": solid((4, 3, 0), (7, 5, 5)), "table": TABLE})["chair"] == ["next to table"]


def test_next_to_is_relative_to_size() -> None:
    sofa, lamp = solid((0, 0, 0), (20, 8, 8)), solid((24, 0, 0), (26, 2, 15))
    cup = solid((0, 12, 0), (1, 13, 2))  # as far from the sofa as the lamp, but farther than it is high
    assert related({"sofa": sofa, "lamp": lamp, "cup": cup})["sofa"] == ["next to lamp"]
    assert related({"sofa": sofa, "picture": solid((0, 0, 10), (10, 1, 14))})["sofa"] == []  # above, not beside


def test_only_sizes_limit_gaps_where_lengths_are_not_meters() -> None:
    things = {"sofa": solid((0, 0, 0), (20, 8, 8)), "lamp": solid((28, 0, 0), (30, 2, 15))}
    assert related(things)["sofa"] == []
    assert related(things, metric=False)["sofa"] == ["next to lamp"]


def test_of_two_things_that_interlock_the_higher_is_on_the_lower() -> None:
    low = solid((0, 0, 1), (6, 4, 2)) | solid((6, 0, 0), (18, 4, 1))
    high = solid((0, 0, 0), (6, 4, 1)) | solid((12, 0, 1), (18, 4, 2))
    assert related({"low": low, "high": high}) == {"low": [], "high": ["on low"]}
    assert related({"high": high, "low": low}) == {"low": [], "high": ["on low"]}


def test_against_a_wall_that_the_thing_itself_hides() -> None:
    wardrobe = solid((10, 1, 1), (20, 7, 22))
    wall = solid((0, 0, 0), (40, 1, 26))
    seen = {cell: value for cell, value in wall.items() if not 10 <= cell[0] < 20}
    assert related({"wardrobe": wardrobe}, seen) == {"wardrobe": ["against wall"]}
    far = solid((10, 5, 1), (20, 11, 22))
    assert related({"wardrobe": far}, seen) == {"wardrobe": []}
    low = {cell: value for cell, value in wall.items() if cell[2] < 8}  # a parapet is no wall
    assert related({"wardrobe": wardrobe}, low) == {"wardrobe": []}
    assert related({"picture": solid((12, 1, 14), (18, 2, 18))}, wall) == {"picture": ["against wall"]}
    column = solid((9, 0, 0), (10, 1, 26))  # is no wall along the side
    assert related({"wardrobe": wardrobe}, column) == {"wardrobe": []}


def test_a_map_without_objects_has_no_relations() -> None:
    assert find_relations(occupancy({(0, 0, 0): NOTHING}), [], np.eye(4)) == []
