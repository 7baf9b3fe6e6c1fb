"""The upright frame of rooms with a known floor, walls and cameras, in any frame."""

import numpy as np
import pytest
from scenes import cameras, gaussians

from freeocc3d.core.transforms import invert, is_rigid, quats_to_rotations, transform
from freeocc3d.tracking.upright.surface_patches import SurfacePatches
from freeocc3d.tracking.upright.upright_frame import (
    UprightFrame,
    compute_start_frame,
    estimate_floor_height,
    estimate_gravity_frame,
    find_upright_frame,
)


def room(seed=0, table=1500, floor=3000, noise=0.004):
    """Surface points of a room of 4 x 6 x 2.5 m, z up, floor at 0, with a table, a ceiling, and a few
    points below the floor as reflections make them, as spheres."""
    rng = np.random.default_rng(seed)

    def sheet(n, low, high, axis):
        points = rng.uniform(low, high, (n, 3))
        points[:, "xyz".index(axis)] += rng.normal(0, noise, n)
        return points

    sheets = [
        sheet(floor, (0, 0, 0), (4, 6, 0), "z"),
        sheet(table, (1, 1, 0.75), (2.5, 2, 0.75), "z"),
        sheet(1500, (0, 0, 0), (0, 6, 2.5), "x"),
        sheet(1000, (0, 0, 0), (4, 0, 2.5), "y"),
        sheet(2500, (0, 0, 2.5), (4, 6, 2.5), "z"),
        sheet(40, (0, 0, -1.5), (4, 6, -0.1), "z"),
    ]
    return gaussians(np.concatenate(sheets), 0.02)


def moved(scene, poses, seed):
    """The same in another frame, and the transform there."""
    rng = np.random.default_rng(seed)
    quat = rng.normal(size=4)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = quats_to_rotations(quat / np.linalg.norm(quat)), rng.uniform(-5, 5, 3)
    return gaussians(transform(T, scene.means.astype(float)), scene.scales), T @ poses, T


@pytest.mark.parametrize("seed", range(4))
def test_floor_walls_and_heading_are_found_in_any_frame(seed) -> None:
    scene, poses, T = moved(room(seed), cameras(), seed)
    found = estimate_gravity_frame(poses, scene) @ T  # from the room's own frame
    assert is_rigid(found)
    assert np.degrees(np.arccos(found[2, 2])) < 0.15
    floor = transform(found, np.array([(0.0, 0, 0), (4, 0, 0), (0, 6, 0), (4, 6, 0)]))
    assert np.abs(floor[:, 2]).max() < 0.015
    turn = np.degrees(np.arctan2(found[1, 0], found[0, 0]))
    assert abs((turn + 45) % 90 - 45) < 0.5  # along the walls …
    assert (found[:3, :3] @ cameras()[0][:3, 2])[0] > 0.6  # … and about where the first camera looked
    np.testing.assert_allclose(transform(found, cameras()[0][:3, 3])[:2], 0, atol=1e-6)


def test_a_table_larger_than_the_visible_floor_is_no_floor() -> None:
    found = estimate_gravity_frame(cameras(), room(table=5000, floor=2000))
    assert abs(transform(found, np.array((2.0, 3, 0)))[2]) < 0.02


def test_the_first_camera_is_the_origin_and_looks_along_x() -> None:
    scene, poses, _ = moved(room(), cameras(), 3)
    T_gravity_map = estimate_gravity_frame(poses, scene)
    T = compute_start_frame(T_gravity_map, poses[0])
    assert is_rigid(T)
    np.testing.assert_allclose(transform(T, poses[0][:3, 3]), 0, atol=1e-9)
    looks = T[:3, :3] @ poses[0][:3, 2]
    assert looks[0] > 0.79
    assert abs(looks[1]) < 1e-9
    np.testing.assert_allclose((T @ invert(T_gravity_map))[2, :3], (0, 0, 1), atol=1e-9)  # z stays up


def shown(*sheets) -> SurfacePatches:
    """Patches of sheets: each the (3,) corner and two (3,) sides of a rectangle, and its normal."""
    points, normals = [], []
    for corner, first, second in np.array(sheets, float):
        steps = [np.arange(0.025, np.linalg.norm(side), 0.05) / np.linalg.norm(side) for side in (first, second)]
        a, b = (grid.reshape(-1, 1) for grid in np.meshgrid(*steps))
        points.append(corner + a * first + b * second)
        normal = np.cross(first, second)
        normals.append(np.tile(normal / np.linalg.norm(normal), (len(a), 1)))
    return SurfacePatches(np.concatenate(points), np.concatenate(normals))


FLOOR = (0, 0, 0), (4, 0, 0), (0, 6, 0)
WALL_X, WALL_Y = ((0, 0, 0.5), (0, 6, 0), (0, 0, 2)), ((0, 0, 0.5), (0, 0, 2), (4, 0, 0))
TABLE = (1, 1, 0.75), (1.5, 0, 0), (0, 1, 0)
SPECKS = (0, 0, 0.6), (0.2, 0, 0), (0, 0.1, 0)  # what noise of a wall may make: 8 level patches, no floor


@pytest.mark.parametrize(
    ("sheets", "by", "floor", "walls"),
    [
        ((FLOOR, TABLE, WALL_X, WALL_Y), "floor", True, True),
        ((WALL_X, WALL_Y), "walls", False, True),
        ((WALL_X,), "cameras", False, True),
        ((WALL_X, WALL_Y, SPECKS), "walls", False, True),
        ((((0, 0, 2.5), (0, 6, 0), (4, 0, 0)), WALL_X), "level surfaces", False, True),
        ((FLOOR,), "floor", True, False),
    ],
    ids=["room", "two walls", "one wall", "specks", "ceiling", "floor"],
)
def test_the_surest_evidence_decides(sheets, by, floor, walls) -> None:
    """Cameras that are rolled by 2 degrees; what is level or upright corrects them."""
    roll = np.eye(4)
    roll[:2, :2] = ((np.cos(0.035), -np.sin(0.035)), (np.sin(0.035), np.cos(0.035)))
    found = find_upright_frame(cameras() @ roll, shown(*sheets))
    assert (found.by, found.floor, found.walls) == (by, floor, walls)
    tilt = np.degrees(np.arccos(found.T_upright_world[2, 2]))
    assert tilt < (0.1 if by != "cameras" else 3.0)
    assert found.off_deg < 5
    if floor:
        assert abs(found.T_upright_world[2, 3]) < 0.01
    if walls:
        turn = np.degrees(np.arctan2(found.T_upright_world[1, 0], found.T_upright_world[0, 0]))
        assert abs((turn + 45) % 90 - 45) < (0.1 if by != "cameras" else 2.0)
    again = UprightFrame.from_array(found.to_array())
    np.testing.assert_array_equal(again.T_upright_world, found.T_upright_world)


@pytest.mark.parametrize(("tilt_deg", "by"), [(30, "level surfaces"), (60, "level surfaces"), (15, "one view")])
def test_one_camera_tells_up_by_a_table_it_looks_down_at(tilt_deg, by) -> None:
    """tilt_deg: of a single plane's normal from the view, toward the image's top. At 15 degrees it may be a wall that
    the camera looks up at, or a table almost straight below."""
    cos, sin = np.cos(np.deg2rad(tilt_deg)), np.sin(np.deg2rad(tilt_deg))
    found = find_upright_frame(np.eye(4)[None], shown(((0, 0, 1), (0, cos, -sin), (1, 0, 0))))
    assert (found.by, found.floor) == (by, by != "one view")
    np.testing.assert_allclose(found.T_upright_world[2, :3], (0, -sin, -cos) if found.floor else (0, -1, 0), atol=1e-6)


def test_without_a_floor_or_anything_there_is_a_frame_still() -> None:
    assert estimate_floor_height(np.array((2.0, 3.0)), 1.5) is None
    nothing = gaussians(np.zeros((0, 3)), np.zeros((0, 3)))
    for poses in (np.zeros((0, 4, 4)), np.eye(4)[None]):
        found = estimate_gravity_frame(poses, nothing)
        assert is_rigid(found)
        np.testing.assert_allclose(found[2, :3], (0, -1, 0), atol=1e-6)
    assert find_upright_frame(np.eye(4)[None], shown(WALL_X)[np.zeros(0, int)]).by == "one view"
    down = np.eye(4)
    down[:3, :3] = np.diag((1.0, -1.0, -1.0))  # looks straight down, z up
    assert is_rigid(estimate_gravity_frame(down[None], room()))
