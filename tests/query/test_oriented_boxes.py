"""Oriented bounding boxes of regions, against turned things with known boxes."""

from __future__ import annotations

import numpy as np
import pytest
from worded_voxels import SIZE, WORDS, box, feature, occupancy

from freeocc3d.core.transforms import invert, transform
from freeocc3d.query.oriented_boxes import _box_around, oriented_boxes
from freeocc3d.query.word_query import query


def turned(yaw: float, up: tuple[float, float, float] = (0.0, 0.0, 1.0)) -> np.ndarray:
    """(4, 4) to a frame whose z is ``up`` of the first and whose x is turned by ``-yaw`` about it."""
    z = np.array(up)
    x = np.cross((0.0, 1.0, 0.0) if abs(z[1]) < 0.9 else (0.0, 0.0, 1.0), z)
    x = x / np.linalg.norm(x)
    y = np.cross(z, x)
    T = np.eye(4)
    T[:3, :3] = np.stack((np.cos(yaw) * x + np.sin(yaw) * y, np.cos(yaw) * y - np.sin(yaw) * x, z))
    T[:3, 3] = (0.3, -0.2, 0.1)
    return T


def test_a_box_along_the_lattice_is_the_axis_aligned_one_and_longest_along_its_x() -> None:
    room = occupancy(box((0, 2, 1), (2, 8, 4), feature(CUP=1)))
    (region,) = query(room, WORDS, ["cup"])[0].regions
    assert region.label == "cup"
    found = oriented_boxes(room, [region], np.eye(4))[0]
    np.testing.assert_allclose(found.extent, (0.6, 0.2, 0.3))
    assert found.yaw == pytest.approx(np.pi / 2)
    np.testing.assert_allclose(found.T_map_box[:3, 3], (region.box_min + region.box_max) / 2)
    np.testing.assert_allclose(found.T_map_box[:3, 0], (0, 1, 0), atol=1e-9)


@pytest.mark.parametrize("yaw", [0.0, 0.4, -1.2, 3.0])
@pytest.mark.parametrize("up", [(0.0, 0.0, 1.0), (0.0, -1.0, 0.0)])
def test_a_box_is_upright_and_holds_every_corner_whatever_the_gravity_frame(yaw: float, up: tuple) -> None:
    things = {v: f for v, f in box((0, 0, 0), (9, 9, 9), feature(CUP=1)).items() if sum(v) % 3 and v[0] + v[1] < 11}
    room = occupancy(things, origin=(1.0, 2.0, 3.0))
    (region,) = query(room, WORDS, ["cup"])[0].regions
    T_gravity_map = turned(yaw, up)
    found = oriented_boxes(room, [region], T_gravity_map)[0]
    np.testing.assert_allclose(found.T_map_box[:3, 2], up, atol=1e-9)
    assert np.linalg.det(found.T_map_box) == pytest.approx(1)
    voxels = room.occupied_voxels()[region.rows]
    corners = np.concatenate([room.origin + (voxels + c) * SIZE for c in np.ndindex(2, 2, 2)])
    inside = transform(invert(found.T_map_box), corners)
    np.testing.assert_allclose(inside.max(axis=0), found.extent / 2, atol=1e-9)
    np.testing.assert_allclose(inside.min(axis=0), -found.extent / 2, atol=1e-9)
    assert found.extent[0] >= found.extent[1] / 1.001
    x_gravity = (T_gravity_map @ found.T_map_box)[:3, 0]
    assert np.arctan2(x_gravity[1], x_gravity[0]) == pytest.approx(found.yaw)


@pytest.mark.parametrize("degrees", [0, 20, -35, 70])
def test_no_rectangle_at_any_angle_is_smaller(degrees: int) -> None:
    """A slab of 1.6 x 0.5 m that stands at an angle to the lattice."""
    a = np.deg2rad(degrees)
    cells = np.stack(np.meshgrid(range(-12, 12), range(-12, 12), indexing="ij"), axis=-1).reshape(-1, 2)
    own = (cells + 0.5) * SIZE @ np.array(((np.cos(a), -np.sin(a)), (np.sin(a), np.cos(a))))
    slab = cells[(np.abs(own) < (0.8, 0.25)).all(axis=1)]
    room = occupancy({(i, j, k): feature(CUP=1) for i, j in slab.tolist() for k in range(2)})
    (region,) = query(room, WORDS, ["cup"])[0].regions
    found = oriented_boxes(room, [region], np.eye(4))[0]
    corners = np.concatenate([(slab + c) * SIZE for c in np.ndindex(2, 2)])
    angles = np.deg2rad(np.arange(0, 90, 0.25))
    along = corners @ np.stack((np.cos(angles), np.sin(angles)))
    across = corners @ np.stack((-np.sin(angles), np.cos(angles)))
    areas = np.ptp(along, axis=0) * np.ptp(across, axis=0)
    assert found.extent[0] * found.extent[1] <= areas.min() + 1e-9
    assert np.abs((found.yaw - a + np.pi / 2) % np.pi - np.pi / 2) < np.deg2rad(8)
    assert found.extent[0] == pytest.approx(1.6, abs=0.25)


@pytest.mark.parametrize("degrees", [0.0, 10.0, -20.0])
def test_of_boxes_that_are_as_small_the_one_turned_least_is_taken(degrees: float) -> None:
    """An octagon, around which a square fits along every side."""
    angles = np.deg2rad(22.5 + 45 * np.arange(8) + degrees)
    outline = np.stack((np.cos(angles), np.sin(angles)), axis=1)
    corners = np.concatenate([np.column_stack((outline + (3, 1), np.full(8, z))) for z in (0.5, 2.0)])
    found = _box_around(corners, np.eye(4))
    assert np.rad2deg(found.yaw) == pytest.approx(degrees, abs=1e-6)
    np.testing.assert_allclose(found.extent, (2 * np.cos(np.pi / 8), 2 * np.cos(np.pi / 8), 1.5))
    np.testing.assert_allclose(found.T_map_box[:3, 3], (3, 1, 1.25), atol=1e-9)
