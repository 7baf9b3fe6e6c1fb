"""Reflections: a room with a mirror, and with a door in its place."""

from dataclasses import replace

import numpy as np
import pytest
from scenes import CAMERA, lifted, posed, wall_frame

from freeocc3d.core.types import FREE, Gaussians, PosedFrame
from freeocc3d.occupancy import build, carve, splat
from freeocc3d.occupancy.confirmed_depth import hide_unconfirmed

DEPTH_M = 5.0  # of the room along y; the mirror hangs there
ROOM = np.array([(0, 0, 0), (4, DEPTH_M, 2.5)])
THINGS = np.array(
    [[(1, 0.3, 0), (2.2, 1.1, 0.8)], [(3.2, 2, 0), (3.9, 3.2, 1.7)], [(0.1, 3.4, 0), (0.9, 4.4, 0.5)]], np.float64
)
OTHER = np.array([(-0.5, DEPTH_M, 0), (4.5, 8, 2.5)]), np.array([[(1.5, 6, 0), (2.5, 7, 1.2)]])
MIRROR = np.array([(1.0, 0.5), (3.0, 2.0)])  # x, z


def cast(origin: np.ndarray, ray: np.ndarray, room: np.ndarray, things: np.ndarray) -> np.ndarray:
    """(H, W) lengths of rays from inside a room to its walls and things."""
    with np.errstate(divide="ignore", invalid="ignore"):
        length = np.maximum(*((side - origin) / ray for side in room)).min(axis=-1)
        for thing in things:
            ends = [(side - origin) / ray for side in thing]
            enter, leave = np.minimum(*ends).max(axis=-1), np.maximum(*ends).min(axis=-1)
            length = np.where((enter <= leave) & (enter > 0), np.minimum(length, enter), length)
    return length


def look(number: int, opening: str) -> PosedFrame:
    angle = 2 * np.pi * number / 24
    forward = np.array((np.cos(angle), np.sin(angle), -0.1)) / np.hypot(1, 0.1)
    right = np.cross(forward, (0, 0, 1)) / np.linalg.norm(np.cross(forward, (0, 0, 1)))
    T = np.eye(4)
    T[:3, :3] = np.stack((right, np.cross(forward, right), forward), axis=1)
    T[:3, 3] = 1.6 + 0.8 * np.cos(number), 2.5 + 0.6 * np.sin(number), 1.4
    v, u = np.indices((CAMERA.height, CAMERA.width))
    ray = np.stack(((u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones(u.shape)), axis=-1) @ T[:3, :3].T
    length = cast(T[:3, 3], ray, ROOM, THINGS)
    hit = T[:3, 3] + length[..., None] * ray
    inside = ((hit[..., ::2] > MIRROR[0]) & (hit[..., ::2] < MIRROR[1])).all(axis=-1)
    inside &= np.abs(hit[..., 1] - DEPTH_M) < 1e-6
    if opening == "mirror":
        beyond = cast(hit - (0, 1e-6, 0), ray * (1, -1, 1), ROOM, THINGS)
    else:
        beyond = cast(hit + (0, 1e-6, 0), ray, *OTHER)
    depth_m = np.where(inside, length + beyond, length).astype(np.float32)
    return posed([replace(wall_frame(1.0, number), depth_m=depth_m)], [T])[0]


def lift(looks: list[PosedFrame], **options: object) -> Gaussians:
    return lifted([each.frame for each in looks], [each.T_world_cam for each in looks], 0.04, **options)


@pytest.mark.parametrize("opening", ["mirror", "door"])
def test_what_a_mirror_shows_is_unknown_and_what_a_door_shows_stays(opening: str) -> None:
    looks = [look(number, opening) for number in range(24)]
    g, every = lift(looks), lift(looks, denoise=False)
    assert (every.means[:, 1] > DEPTH_M + 0.2).sum() > 3000
    seen = hide_unconfirmed(looks, g, 0.08)
    made = build.build_occupancy(g, np.zeros((len(g), 0), np.float16), seen, splat.Options(), carve.Options())
    free = (made.voxels(FREE) + 0.5) * made.voxel_size
    assert (free[:, 1] < DEPTH_M - 0.2).sum() > 40_000
    if opening == "door":
        assert (g.means[:, 1] > DEPTH_M + 0.2).sum() > 3000
        assert (free[:, 1] > DEPTH_M + 0.2).sum() > 3000
    else:
        assert (g.means[:, 1] > DEPTH_M + 0.2).sum() == 0
        assert (free[:, 1] > DEPTH_M + 0.2).sum() == 0
    assert (np.abs(g.means[:, 1]) < 0.1).sum() > 1000
