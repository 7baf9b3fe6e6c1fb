"""Standing places in rooms of 10 cm voxels with the floor in layer k = 0."""

from __future__ import annotations

import numpy as np
import pytest

from freeocc3d.core.transforms import transform
from freeocc3d.core.types import BLOCK, FREE, OCCUPIED, Occupancy
from freeocc3d.query.regions import Region
from freeocc3d.query.standing_places import Robot, standing_places

SIZE = 0.1
SIDE = 40  # voxels
T_GRAVITY_MAP = np.eye(4)
T_GRAVITY_MAP[2, 3] = -SIZE / 2


def room(*things: tuple[tuple[int, int, int], tuple[int, int, int]]) -> tuple[Occupancy, Region]:
    """A room of 4 x 4 x 2.4 m without walls, all of which is free but the floor and boxes of voxels, and the region of
    the first box."""
    filled = np.zeros((SIDE, SIDE, 24), np.int64)
    filled[:, :, 0] = 1
    for number, (low, high) in enumerate(things):
        filled[tuple(slice(a, b) for a, b in zip(low, high, strict=True))] = 2 + number
    keys = np.stack(np.indices((SIDE // BLOCK, SIDE // BLOCK, 3)), axis=-1).reshape(-1, 3).astype(np.int32)
    inner = np.stack(np.indices((BLOCK,) * 3), axis=-1).reshape(-1, 3)
    values = filled[tuple((keys[:, None] * BLOCK + inner).transpose(2, 0, 1))]
    state = np.where(values > 0, OCCUPIED, FREE).astype(np.uint8)
    counts = np.zeros(state.shape, np.uint16)
    made = Occupancy(SIZE, np.zeros(3), keys, np.ones(state.shape, np.float32), counts, counts, state)
    made = made.replace(colors=np.zeros((np.count_nonzero(state), 3), np.uint8))
    rows = np.flatnonzero(values[state == OCCUPIED] == 2)
    return made, Region(1.0, 1.0, np.zeros(3), np.zeros(3), np.ones(3), 1.0, rows)


CUP = (20, 20, 1), (22, 22, 3)


def place(*things, robot: Robot | None = None, T: np.ndarray = T_GRAVITY_MAP) -> np.ndarray | None:
    made, region = room(*things)
    return standing_places(made, T, [region], robot)[0]


@pytest.mark.parametrize("radius", [0.2, 0.3, 0.5])
def test_the_nearest_place_is_as_far_as_the_robot_is_wide(radius: float) -> None:
    at = place(CUP, robot=Robot(radius))
    assert at is not None
    assert at[2] == pytest.approx(SIZE / 2)
    beyond = np.maximum(np.maximum((2.0, 2.0) - at[:2], at[:2] - (2.2, 2.2)), 0)
    assert radius - 1e-9 <= np.linalg.norm(beyond) <= radius + 1.5 * SIZE


def test_no_robot_stands_over_the_edge_of_what_is_known() -> None:
    at = place(((0, 0, 1), (1, 1, 3)), robot=Robot(0.5))
    assert at is not None
    assert (at[:2] >= 0.5 - 1e-9).all()


def test_a_screen_in_front_of_a_thing_is_walked_around() -> None:
    screen = (10, 17, 1), (32, 18, 20)
    thing = (20, 18, 1), (22, 20, 3)
    nearer = place(thing, screen, robot=Robot(0.2))
    assert nearer is not None
    assert nearer[1] > 1.8
    full = (0, 20, 1), (40, 40, 24)  # no room but on the screen's far side, and beyond its ends
    around = place(thing, screen, full, robot=Robot(0.2))
    assert around is not None
    assert around[0] < 1.0 or around[0] > 3.2
    low = (10, 17, 1), (32, 18, 3)
    over = place(((20, 18, 1), (22, 20, 4)), low, full, robot=Robot(0.2))
    assert over is not None
    assert 1.7 < over[0] < 2.5


def test_what_is_enclosed_is_seen_from_nowhere() -> None:
    walls = [
        ((15, 15, 1), (27, 16, 24)),
        ((15, 26, 1), (27, 27, 24)),
        ((15, 15, 1), (16, 27, 24)),
        ((26, 15, 1), (27, 27, 24)),
    ]
    assert place(((20, 20, 1), (22, 22, 24)), *walls, robot=Robot(0.5)) is None
    assert place(((20, 20, 1), (22, 22, 24)), *walls[1:], robot=Robot(0.5)) is not None


def test_a_robot_stands_below_a_lamp_but_not_below_a_table() -> None:
    under_lamp = place(((20, 20, 20), (22, 22, 22)))
    assert under_lamp is not None
    assert np.linalg.norm(under_lamp[:2] - 2.1) < 0.15
    table = (12, 12, 12), (30, 30, 13)
    beside = place(((20, 20, 13), (22, 22, 14)), table)
    assert beside is not None
    assert np.maximum(np.maximum(1.2 - beside[:2], beside[:2] - 3.0), 0).max() >= 0.3 - SIZE
    assert place(((20, 20, 13), (22, 22, 14)), table, robot=Robot(height=1.0)) is None  # it sees no top from below
    assert place(((20, 20, 11), (22, 22, 12)), table, robot=Robot(height=1.0)) is not None


def test_a_turned_gravity_frame_gives_the_same_place() -> None:
    angle = 0.5
    T = np.eye(4)
    T[:2, :2] = ((np.cos(angle), -np.sin(angle)), (np.sin(angle), np.cos(angle)))
    T[:3, 3] = (3.0, -1.0, -SIZE / 2)
    at = place(((20, 20, 20), (22, 22, 22)), T=T)
    assert at is not None
    assert transform(T, at)[2] == pytest.approx(0, abs=1e-9)
    assert np.linalg.norm(at[:2] - 2.1) < 0.2


def test_a_map_of_small_voxels_in_larger_ones_has_the_same_place() -> None:
    made, region = room(((20, 20, 20), (22, 22, 22)))
    smaller = made.replace(voxel_size=2 * SIZE, levels=np.ones(len(made.keys), np.uint8))
    assert smaller.finest == SIZE
    T = T_GRAVITY_MAP.copy()
    T[2, 3] = -SIZE
    (at,) = standing_places(smaller, T, [region])
    assert at is not None
    assert np.linalg.norm(at[:2] - 2.1) < 0.3


def test_a_map_without_a_voxel_has_no_place() -> None:
    made, region = room(CUP)
    empty = made.replace(state=np.zeros_like(made.state), colors=np.zeros((0, 3), np.uint8))
    nothing = Region(1.0, 1.0, region.centroid, region.box_min, region.box_max, 1.0, np.zeros(0, np.int64))
    assert standing_places(empty, T_GRAVITY_MAP, [nothing]) == [None]
