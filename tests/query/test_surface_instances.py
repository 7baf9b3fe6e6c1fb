"""Things of a drawn room that no classes tell apart: a chest on the floor, a parcel on it, a picture on a wall."""

import numpy as np
import pytest

from freeocc3d.core.types import FREE, OCCUPIED, Occupancy
from freeocc3d.query.objects import surface_instances
from freeocc3d.query.objects.structure import find_floor, find_structure
from freeocc3d.query.objects.surfels import Surfels, join_neighbors

STEP, VOXEL = 0.04, 0.08
WHITE, RED, BLUE = (90.0, 0.0, 0.0), (50.0, 60.0, 40.0), (40.0, 10.0, -50.0)


class Room:
    """Rectangles of surfels, each along two axes, which face along the third."""

    def __init__(self) -> None:
        self.points, self.normals, self.lab, self.names = [], [], [], []

    def add(self, name: str, low, high, normal, color=WHITE) -> None:
        spans = [np.arange(a + STEP / 2, b, STEP) if b > a else np.array([a]) for a, b in zip(low, high, strict=True)]
        grid = np.stack(np.meshgrid(*spans, indexing="ij"), axis=-1).reshape(-1, 3)
        self.points.append(grid)
        self.normals.append(np.tile(np.array(normal, float), (len(grid), 1)))
        self.lab.append(np.tile(color, (len(grid), 1)))
        self.names += [name] * len(grid)

    def box(self, name: str, low, high, color=WHITE) -> None:
        """The sides and the top of a box."""
        for axis in range(3):
            for end, sign in ((low, -1), (high, 1)):
                if axis < 2 or sign > 0:
                    first, last, normal = list(low), list(high), [0, 0, 0]
                    first[axis] = last[axis] = end[axis]
                    normal[axis] = sign
                    self.add(name, first, last, normal, color)

    def surfels(self) -> Surfels:
        return join_neighbors(*map(np.concatenate, (self.points, self.normals, self.lab)))


@pytest.fixture(scope="module")
def room() -> Room:
    """4 m x 3 m x 2.4 m with a wall at y = 0, a red picture flush with it, and a chest with a parcel on it."""
    made = Room()
    made.add("floor", (0, 0, 0), (4, 3, 0), (0, 0, 1))
    made.add("wall", (0, 0, 0), (1.2, 0, 2.4), (0, 1, 0))
    made.add("wall", (1.2, 0, 0), (1.8, 0, 1), (0, 1, 0))
    made.add("picture", (1.2, 0, 1), (1.8, 0, 1.6), (0, 1, 0), RED)
    made.add("wall", (1.2, 0, 1.6), (1.8, 0, 2.4), (0, 1, 0))
    made.add("wall", (1.8, 0, 0), (4, 0, 2.4), (0, 1, 0))
    made.box("chest", (2, 0.8, 0.04), (3.2, 1.6, 0.8))
    made.box("parcel", (2.4, 1, 0.84), (2.8, 1.4, 1.2), BLUE)
    return made


def free_air(room: Room) -> Occupancy:
    """The voxels of the room: free, but for those of surfels and those inside the boxes."""
    shape = np.array((7, 6, 4)) * 8
    keys = np.stack(np.meshgrid(*map(np.arange, (7, 6, 4)), indexing="ij"), axis=-1).reshape(-1, 3).astype(np.int32)
    origin = np.array((-0.4, -0.4, -0.04))
    centers = origin + (np.stack(np.indices(shape), axis=-1) + 0.5) * VOXEL
    state = np.where((centers[..., 1] > 0) & (centers[..., 2] > 0), FREE, 255).astype(np.uint8)
    for low, high in (((2, 0.8, 0), (3.2, 1.6, 0.8)), ((2.4, 1, 0.8), (2.8, 1.4, 1.2))):
        state[((centers > low) & (centers < high)).all(axis=-1)] = 255
    state[tuple(np.floor((np.concatenate(room.points) - origin) / VOXEL).astype(int).T)] = OCCUPIED
    blocks = state.reshape(7, 8, 6, 8, 4, 8).transpose(0, 2, 4, 1, 3, 5).reshape(len(keys), 512)
    counts = np.zeros(blocks.shape, np.uint16)
    return Occupancy(VOXEL, origin, keys, np.ones(blocks.shape, np.float32), counts, counts, blocks)


def test_a_wall_bounds_the_room_and_the_side_of_a_chest_does_not(room) -> None:
    surfels, names = room.surfels(), np.array(room.names)
    floor = find_floor(surfels, VOXEL)
    assert set(names[floor]) == {"floor"}
    parts = surface_instances.find_parts(surfels, ~floor, 0.17)
    found = find_structure(surfels, parts, free_air(room), np.eye(4))
    assert found[names == "wall"].mean() > 0.95
    assert set(names[found & ~floor]) == {"wall", "picture"}


def test_things_that_touch_are_kept_apart_by_corners_and_colors(room) -> None:
    surfels, names = room.surfels(), np.array(room.names)
    thing = surface_instances.divide_surfels(surfels, free_air(room), np.eye(4))
    for name in ("chest", "parcel", "picture"):
        values, count = np.unique(thing[names == name], return_counts=True)
        assert count.max() > 0.9 * count.sum()
        assert (names[thing == values[np.argmax(count)]] == name).mean() > 0.9
    assert (thing[np.isin(names, ("floor", "wall"))] == -1).mean() > 0.95


def test_concavity_is_positive_in_corners_negative_around_edges_and_zero_on_planes() -> None:
    points = np.array(((1.0, 0, 0), (0, 0, 1), (0, 0, 0), (1, 0, 0)))
    up, along = (0, 0, 1.0), (1.0, 0, 0)
    for normals, sign in (((up, along), 1), ((np.negative(up), np.negative(along)), -1)):
        surfels = Surfels(points[:2], np.array(normals), points[:2], np.array(((0, 1),)), 1.0)
        assert surfels.concavities(surfels.pairs)[0] == pytest.approx(sign * np.sqrt(2))
    level = Surfels(points[2:], np.array((up, up)), points[2:], np.array(((0, 1),)), 1.0)
    assert level.concavities(level.pairs)[0] == level.steps(level.pairs)[0] == 0


@pytest.mark.parametrize("count", [1, 2, 12])
def test_a_few_or_coinciding_surfels_are_no_walls(count, room) -> None:
    random = np.random.default_rng(count)
    for points in (random.uniform(0, 0.1, (count, 3)) + (2, 2, 1), np.ones((count, 3))):
        surfels = join_neighbors(points, np.tile((1.0, 0.0, 0.0), (count, 1)), points)
        assert (surface_instances.divide_surfels(surfels, free_air(room), np.eye(4)) >= 0).all()
