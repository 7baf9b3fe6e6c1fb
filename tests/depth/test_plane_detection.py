"""The planes of a room with bare walls, found from its edges; ray intersections against a plain reference."""

from dataclasses import dataclass, fields

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from freeocc3d.depth.building_planes import Layout, Plane
from freeocc3d.depth.plane_detection import detect_layout, find_directions
from freeocc3d.depth.scan_points import ScanPoints

_SIZE = np.array((5.0, 4.0, 2.6))
_CELL = 0.02
_NOISE = 0.003
_WORLD = Rotation.from_rotvec((0.4, -1.1, 2.3)).as_matrix()  # of the room's axes
_SHIFT = np.array((3.0, -7.0, 11.0))
_FURNITURE = (  # lower and upper corners
    ((0.3, 0.3, 0.0), (1.7, 1.2, 0.5)),
    ((3.4, 2.6, 0.0), (4.4, 3.4, 0.74)),
    ((0.5, 3.0, 0.0), (1.1, 3.6, 1.9)),
)
_DOOR = ((3.0, -0.01, 0.0), (4.0, 0.01, 2.0))  # in the wall at y = 0
_BEHIND = 2.5  # meters: the wall that is seen through it


@dataclass(frozen=True)
class _Room:
    points: ScanPoints
    centers: np.ndarray
    normals: np.ndarray
    planes: Layout


def _rectangle(lower, upper) -> np.ndarray:
    """One point a cell."""
    steps = [np.arange(a + _CELL / 2, b, _CELL) if b > a else np.array([a]) for a, b in zip(lower, upper, strict=True)]
    return np.stack(np.meshgrid(*steps, indexing="ij"), axis=-1).reshape(-1, 3)


def _sides(lower, upper) -> list[np.ndarray]:
    sides = []
    for axis in range(3):
        for at in (lower[axis], upper[axis]):
            first, last = np.array(lower, float), np.array(upper, float)
            first[axis] = last[axis] = at
            sides.append(_rectangle(first, last))
    return sides


def _to_rim(points: np.ndarray, lower, upper) -> np.ndarray:
    """How far points of a side of a box are from the side's edges."""
    return np.sort(np.minimum(points - lower, np.asarray(upper) - points), axis=1)[:, 1]


def _within(points: np.ndarray, lower, upper, margin: float = 0.0) -> np.ndarray:
    return ((points > np.array(lower) - margin) & (points < np.array(upper) + margin)).all(axis=1)


def _crosses(start: np.ndarray, ends: np.ndarray, lower, upper) -> np.ndarray:
    """Whether the way from a point to others leads through a box."""
    with np.errstate(divide="ignore", invalid="ignore"):
        a, b = (lower - start) / (ends - start), (upper - start) / (ends - start)
    first, last = np.nanmax(np.minimum(a, b), axis=1), np.nanmin(np.maximum(a, b), axis=1)
    return (np.maximum(first, 0.0) < np.minimum(last, 1.0) - 1e-9) & (first < 1.0 - 1e-6)


def _through_door(start: np.ndarray, ends: np.ndarray) -> np.ndarray:
    share = start[1] / np.maximum(start[1] - ends[:, 1], 1e-9)
    return _within(start + share[:, None] * (ends - start), *_DOOR)


def _room(behind: int = 0) -> _Room:
    """A box whose edges, floor and window frame were measured; with ``behind``, it has a door, and about as many points
    of the wall and the floor behind it."""
    rng = np.random.default_rng(0)
    zero = np.zeros(3)
    parts = [side[_to_rim(side, zero, _SIZE) < 0.06] for side in _sides(zero, _SIZE)]
    parts.append(_rectangle(zero, (*_SIZE[:2], 0.0)))
    window = _rectangle((5.0, 1.2, 0.9), (5.0, 2.6, 2.0))
    parts.append(window[_to_rim(window, (0.0, 1.2, 0.9), (10.0, 2.6, 2.0)) < 0.06])
    for box in _FURNITURE:
        parts += [side for side in _sides(*box) if side[0, 2] > 0.0]
    points = np.concatenate(parts)
    cameras = rng.uniform((1.0, 1.0, 1.2), (4.0, 2.6, 1.7), (12, 3))
    if behind:
        points = points[~_within(points, *_DOOR)]
        jambs = [side for side in _sides(*_DOOR) if np.ptp(side[:, 1]) > 0.0]
        wall = rng.uniform((0.0, -_BEHIND, 0.0), (7.0, -_BEHIND, 2.6), (25 * behind, 3))
        floor = rng.uniform((0.0, -_BEHIND, 0.0), (7.0, -0.1, 0.0), (25 * behind, 3))
        parts = [part[_through_door(cameras[0], part)][: behind // 2] for part in (wall, floor)]
        points = np.concatenate((points, *jambs, *parts))
    rays = []
    for camera, center in enumerate(cameras):
        hidden = np.zeros(len(points), bool)
        for lower, upper in _FURNITURE:
            hidden |= _crosses(center, points, lower, upper)
        hidden |= (points[:, 1] < -0.05) & ~_through_door(center, points)
        rays.append(np.stack((np.flatnonzero(~hidden), np.full(np.count_nonzero(~hidden), camera)), axis=1))
    ray_point, ray_camera = np.concatenate(rays).T.astype(np.int32)
    measured = points + _NOISE * rng.normal(size=points.shape)
    sigma_m = rng.uniform(0.5, 1.5, len(points)) * _NOISE
    normals = np.repeat(np.eye(3)[[2, 0, 1]], (1500, 500, 400), axis=0) + 0.04 * rng.normal(size=(2400, 3))
    normals *= rng.choice((-1.0, 1.0), (2400, 1)) / np.linalg.norm(normals, axis=1, keepdims=True)
    found = ScanPoints(_world(measured), sigma_m, ray_point, ray_camera, _CELL)
    centers = _world(cameras)
    return _Room(found, centers, normals @ _WORLD.T, detect_layout(found, centers, normals @ _WORLD.T))


def _world(points: np.ndarray) -> np.ndarray:
    return points @ _WORLD.T + _SHIFT


@pytest.fixture(scope="module")
def room() -> _Room:
    return _room()


def _toward(room: _Room, targets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    origin = room.centers[0]
    return origin, _world(targets) - origin


def _bare(axis: int, at: float) -> np.ndarray:
    """Points of a wall on which nothing was measured."""
    rng = np.random.default_rng(1)
    points = rng.uniform(0.3, _SIZE - 0.3, (500, 3))
    points[:, axis] = at
    return points


_WALLS = [(axis, at) for axis in range(3) for at in (0.0, float(_SIZE[axis]))]


def test_the_directions_are_the_rooms(room) -> None:
    axes = find_directions(room.points, room.normals)
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-9)
    cosine = np.abs(axes @ _WORLD)
    assert sorted(cosine.argmax(axis=1)) == [0, 1, 2]
    assert np.degrees(np.arccos(np.minimum(cosine.max(axis=1), 1.0))).max() < 0.15
    assert cosine[0].argmax() == 2  # the floor holds most points
    assert np.degrees(np.arccos(min(cosine[0, 2], 1.0))) < 0.02


@pytest.mark.parametrize(("axis", "at"), _WALLS)
def test_the_outermost_planes_are_the_rooms(room, axis: int, at: float) -> None:
    outermost = [plane for plane in room.planes.planes if plane.outermost]
    assert len(outermost) == 6
    outwards = _WORLD[:, axis] * (1.0 if at else -1.0)
    (plane,) = (plane for plane in outermost if plane.normal @ outwards > 0.9)
    corners = _SIZE * np.array(np.meshgrid((0, 1), (0, 1), (0, 1))).reshape(3, -1).T
    corners = corners[corners[:, axis] == at]
    np.testing.assert_allclose(_world(corners) @ plane.normal, plane.offset, atol=0.5 * _CELL)


@pytest.mark.parametrize(("axis", "at"), _WALLS)
@pytest.mark.parametrize("short", [0.93, 0.97, 1.0])
def test_bare_walls_are_where_rays_reach_the_edges_planes(room, axis: int, at: float, short: float) -> None:
    origin, ways = _toward(room, _bare(axis, at))
    found = room.planes.near(origin, ways, np.full(len(ways), short))
    right = np.abs(found - 1.0) * np.abs(ways @ _WORLD[:, axis]) < 0.5 * _CELL
    assert right.mean() > (0.95 if axis < 2 or at else 0.8)  # furniture stands on the floor


def test_no_plane_is_taken_far_from_the_surface(room) -> None:
    for axis, at in _WALLS:
        origin, ways = _toward(room, _bare(axis, at))
        times = np.random.default_rng(2).uniform(0.7, 1.2, len(ways))
        found = room.planes.near(origin, ways, times)
        assert ((found == 0) | (found > 0.97 * times)).all()
        assert (found < 1.1 * times).all()
        assert (found > 0).any()


@pytest.mark.parametrize("behind", [400, 4000])
def test_a_door_that_is_seen_through_stays_open(behind: int) -> None:
    """Few points behind it leave its wall the outermost one, many do not."""
    room = _room(behind)
    outwards, corner = -_WORLD[:, 1], _world(np.zeros(3))
    (back,) = (plane for plane in room.planes.planes if plane.outermost and plane.normal @ outwards > 0.9)
    off = back.offset - corner @ back.normal
    assert off == pytest.approx(0.0 if behind == 400 else _BEHIND, abs=_CELL)
    rng = np.random.default_rng(3)
    origin, ways = _toward(room, rng.uniform((3.1, 0.0, 0.2), (3.9, 0.0, 1.9), (500, 3)))
    found = room.planes.near(origin, ways, np.full(len(ways), 0.98))
    assert (found == 0).mean() > 0.99
    origin, ways = _toward(room, rng.uniform((0.5, 0.0, 2.2), (2.6, 0.0, 2.4), (500, 3)))
    found = room.planes.near(origin, ways, np.full(len(ways), 0.98))
    if behind == 400:
        assert (np.abs(found - 1.0) < 0.01).mean() > 0.95


def _random_planes(rng: np.random.Generator, count: int) -> list[Plane]:
    turns = Rotation.random(count, random_state=0).as_matrix()
    return [
        Plane(
            turn[0], rng.normal(), turn[1:], rng.uniform(-3.0, -1.0, 2), rng.uniform(0.2, 0.6),
            rng.random(rng.integers(1, 25, 2)) < 0.6, bool(rng.random() < 0.4),
        )
        for turn in turns
    ]  # fmt: skip


def _plainly(planes: list[Plane], origin: np.ndarray, way: np.ndarray, time: float) -> float:
    times = []
    for plane in planes:
        t = (plane.offset - plane.normal @ origin) / (plane.normal @ way)
        u, v = (plane.axes @ (origin + t * way) - plane.corner) / plane.square
        inside = 0 <= u < plane.support.shape[0] and 0 <= v < plane.support.shape[1]
        near = 0.97 * time < t < (1.1 if plane.outermost else 1.05) * time
        if near and inside and plane.support[int(u), int(v)]:
            times.append(t)
    return min(times, default=0.0)


def test_rays_meet_planes_as_plainly_computed() -> None:
    rng = np.random.default_rng(4)
    planes = _random_planes(rng, 120)
    found = []
    for _ in range(20):
        origin, ways, times = rng.normal(size=3), rng.normal(size=(60, 3)), rng.uniform(-0.5, 3.0, 60)
        times[:5] = 0.0
        found.append(Layout(planes).near(origin, ways, times))
        expected = [_plainly(planes, origin, way, time) for way, time in zip(ways, times, strict=True)]
        np.testing.assert_allclose(found[-1], expected, rtol=1e-9)
    assert 0.1 < (np.concatenate(found) > 0).mean() < 0.9


def test_planes_along_rays_and_layouts_without_planes_are_never_met() -> None:
    across = Plane(np.eye(3)[2], 0.0, np.eye(3)[:2], np.full(2, -5.0), 1.0, np.ones((10, 10), bool), True)
    ways = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, 0.0]])
    for planes in ([across], []):
        for height in (0.0, 1.0):
            assert not Layout(planes).near(np.array((0.0, 0.0, height)), ways, np.ones(3)).any()
    assert Layout([across]).near(np.array((0.0, 0.0, -1.0)), ways, np.ones(3)).tolist() == [0.0, 1.0, 0.0]
    assert Layout([across]).near(np.zeros(3), ways[:0], np.zeros(0)).shape == (0,)


@pytest.mark.parametrize("count", [0, 1, 7])
def test_layouts_come_back_from_arrays(count: int) -> None:
    planes = _random_planes(np.random.default_rng(5), count)
    arrays = Layout(planes).to_arrays()
    for name, (kind, dimensions) in Layout.EXPECTED.items():
        assert (arrays[name].dtype.kind, arrays[name].ndim) == (kind, dimensions)
    back = Layout.from_arrays(arrays).planes
    assert len(back) == count
    for plane, again in zip(planes, back, strict=True):
        for field in fields(Plane):
            np.testing.assert_array_equal(getattr(again, field.name), getattr(plane, field.name))


def _without_last(name: str):
    return lambda arrays: {name: arrays[name][:-1]}


@pytest.mark.parametrize(
    "damage",
    [
        *(_without_last(name) for name in Layout.EXPECTED),
        lambda arrays: {"shapes": -arrays["shapes"]},
        lambda arrays: {"shapes": arrays["shapes"] * [[0, 1]]},
        lambda arrays: {"shapes": arrays["shapes"] * 2},
        lambda arrays: {"shapes": arrays["shapes"] + [[1 << 62, 4]]},
        lambda arrays: {"shapes": arrays["shapes"][:, :1]},
        lambda arrays: {"shapes": np.concatenate((arrays["shapes"], np.ones_like(arrays["shapes"])), axis=1)},
        lambda arrays: {"normals": arrays["normals"][:, :2]},
        lambda arrays: {"axes": arrays["axes"].transpose(0, 2, 1)},
        lambda arrays: {"corners": arrays["corners"][:, :1]},
        lambda arrays: {"squares": arrays["squares"] * 0.0},
        lambda arrays: {"offsets": arrays["offsets"] * np.nan},
        lambda arrays: {"normals": arrays["normals"] / 0.0},
    ],
)
def test_damaged_arrays_are_refused(damage) -> None:
    arrays = Layout(_random_planes(np.random.default_rng(6), 3)).to_arrays()
    with np.errstate(all="ignore"), pytest.raises(ValueError, match="planes"):
        Layout.from_arrays({**arrays, **damage(arrays)})


def _measured(points: np.ndarray, centers: np.ndarray) -> ScanPoints:
    ray_point, ray_camera = np.indices((len(points), len(centers))).reshape(2, -1).astype(np.int32)
    return ScanPoints(points, np.full(len(points), _NOISE), ray_point, ray_camera, _CELL)


@pytest.mark.parametrize("count", [0, 4, 59])
def test_few_points_make_no_planes(count: int) -> None:
    points, centers = np.random.default_rng(7).random((count, 3)), np.ones((2, 3))
    assert detect_layout(_measured(points, centers), centers, np.eye(3)).planes == ()


def test_points_without_surfaces_make_no_planes() -> None:
    points, centers = np.random.default_rng(7).random((500, 3)), np.ones((2, 3))
    assert detect_layout(_measured(points, centers), centers, np.zeros((0, 3))).planes == ()


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("spread", [0.0, 1e-9, _NOISE])
@pytest.mark.parametrize("extent", [(0.0, 0.0, 0.0), (5.0, 0.0, 0.0), (5.0, 4.0, 0.0)], ids=["place", "line", "plane"])
def test_points_of_one_plane_alone_do_no_harm(extent, spread: float) -> None:
    rng = np.random.default_rng(8)
    points = rng.random((8000, 3)) * extent + spread * rng.normal(size=(8000, 3))
    centers = np.array([(2.5, 2.0, 1.5)] * 4)  # all cameras at one place
    detect_layout(_measured(points, centers), centers, np.eye(3)[2:])  # along the axes, all numbers are exact
    found = detect_layout(_measured(_world(points), _world(centers)), _world(centers), _WORLD.T[2:])
    for plane in found.planes:
        assert all(np.isfinite(getattr(plane, field.name)).all() for field in fields(Plane))
    if min(extent[:2]) > 0:
        level = [plane for plane in found.planes if abs(plane.normal @ _WORLD[:, 2]) > 0.9999]
        assert any(abs(_world(np.zeros(3)) @ plane.normal - plane.offset) < 0.1 * _CELL for plane in level)


@pytest.mark.parametrize("far", [100.0, 0.45e4])
def test_one_point_far_away_changes_little(room, far: float) -> None:
    given, centers = room.points, room.centers
    points = np.concatenate((given.points, _world(np.array([[far, -2.0 * far, 0.7 * far]]))))
    more = ScanPoints(points, np.append(given.sigma_m, _NOISE), np.append(given.ray_point, np.int32(len(points) - 1)),
                  np.append(given.ray_camera, np.int32(0)), _CELL)  # fmt: skip
    planes = detect_layout(more, centers, room.normals).planes
    assert sum(plane.outermost for plane in planes) == 6


def test_planes_of_pieces_far_apart_take_no_memory() -> None:
    points = np.random.default_rng(9).random((16000, 3)) * (5.0, 4.0, 0.0)
    points[8000:] += 3000.0, 2000.0, 0.0
    centers = np.array([(2.5, 2.0, 1.5), (2.0, 2.0, 1.5)])
    for plane in detect_layout(_measured(points, centers), centers, np.eye(3)[2:]).planes:
        assert plane.support.size <= 1 << 24


@pytest.mark.parametrize("gap", [2.0, 2.5, 3.0])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_two_sheets_a_few_cells_apart_are_two_planes_of_their_size(gap: float, axis: int) -> None:
    """The same points are not found a second time, and none of the other sheet's are taken away."""
    rng = np.random.default_rng(axis)
    sheet = _rectangle((0.0, 0.0, 0.0), (2.0, 1.5, 0.0))
    points = np.concatenate([sheet + (0.0, 0.0, height) for height in (0.0, gap * _CELL)])
    points = np.roll(points + 0.001 * rng.normal(size=points.shape), axis + 1, axis=1)  # the sheets are across ``axis``
    centers = np.roll(np.array([(1.0, 0.7, 1.5), (0.5, 0.5, 1.4)]), axis + 1, axis=1)
    layout = detect_layout(_measured(points, centers), centers, np.eye(3)[[axis]])
    planes = sorted((plane for plane in layout.planes if not plane.outermost), key=lambda plane: abs(plane.offset))
    assert len(planes) == 2
    for plane, height in zip(planes, (0.0, gap * _CELL), strict=True):
        assert abs(plane.normal[axis]) > 0.9999
        assert abs(plane.offset) == pytest.approx(height, abs=0.001)
        middles = plane.corner + (np.argwhere(plane.support) + 0.5) * plane.square
        there = np.roll(middles @ plane.axes + plane.normal * plane.offset, -axis - 1, axis=1)
        np.testing.assert_allclose(there[:, :2].min(axis=0), 0.0, atol=1.5 * plane.square)
        np.testing.assert_allclose(there[:, :2].max(axis=0), (2.0, 1.5), atol=1.5 * plane.square)
        assert len(middles) * plane.square**2 == pytest.approx(3.0, rel=0.07)
