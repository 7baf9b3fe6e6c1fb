"""The built-in room: what is in it, that it is rendered exactly, and that its noise is a sensor's."""

import numpy as np
import pytest

from freeocc3d.capture import base, open_capture, room
from freeocc3d.errors import CaptureError, ConfigError
from freeocc3d.geometry import invert, is_rigid, project, transform
from freeocc3d.types import FREE, UNKNOWN


def open_room(noise: bool = True, width: int = 160, frames: int = 240):
    own = {"synthetic": {"noise": noise, "width": width, "height": width * 3 // 4, "frames": frames}}
    return open_capture("builtin:room", base.Options(), own)


def test_the_room_is_furnished() -> None:
    furnished = room.furnished()
    shell = {"floor", "ceiling", "wall"}
    things = [name for name in furnished.objects if name not in shell]
    assert len(things) >= 12
    assert len(set(things)) >= 8
    assert things.count("cup") == 2
    assert set(furnished.objects) <= set(room.CLASSES)
    red, yellow = room.CUPS.values()
    assert 0.08 < np.linalg.norm(np.subtract(red, yellow)) < 0.2


def test_triangles_face_outwards_and_none_is_degenerate() -> None:
    for shape, volume in (
        (room.box((0, 0, 0), (1, 2, 3)), 6.0),
        (room.lathe((3, 1), [(0, 0), (0.5, 0), (0.5, 2), (0, 2)], 200), np.pi * 0.25 * 2),
    ):
        a, b, c = shape.transpose(1, 0, 2)
        assert np.einsum("ni,ni->n", a, np.cross(b, c)).sum() / 6 == pytest.approx(volume, rel=1e-3)
        assert (np.linalg.norm(np.cross(b - a, c - a), axis=1) > 0).all()


def test_a_frame_is_the_same_whenever_it_is_asked_for() -> None:
    one, other = open_room(), open_room()
    frames = {i: one[i] for i in (3, 100)}
    for i in (100, 3):
        again = other[i]
        np.testing.assert_array_equal(again.color, frames[i].color)
        np.testing.assert_array_equal(again.depth_m, frames[i].depth_m)
    assert (one[3].depth_m != one[4].depth_m).any()


def test_the_walk_is_closed_rigid_and_slow_enough_to_track() -> None:
    capture = open_room()
    poses = np.stack([capture.pose(i) for i in range(len(capture))])
    assert all(is_rigid(T) for T in poses)
    steps = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0, append=poses[:1, :3, 3]), axis=1)
    assert steps.max() < 0.03
    turns = np.einsum("nji,njk->nik", poses[:-1, :3, :3], poses[1:, :3, :3])
    assert np.degrees(np.arccos((np.trace(turns, axis1=1, axis2=2) - 1) / 2)).max() < 2.5


def test_exact_depth_is_that_of_the_walls_planes() -> None:
    capture = open_room(noise=False)
    frame, labels = capture[0], capture.labels(0)
    T = capture.pose(0)
    v, u = np.nonzero(labels == room.CLASSES.index("wall"))
    camera = frame.intrinsics
    rays = np.stack(((u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(len(u))), axis=1)
    points = transform(T, rays * frame.depth_m[v, u][:, None])
    x, y, _ = np.abs(points).T
    distance = np.minimum(np.abs(x - room.SIZE[0] / 2), np.abs(y - room.SIZE[1] / 2))
    assert len(v) > 500
    assert distance.max() < 1e-4


def test_the_cups_stand_where_they_are_said_to_in_their_colours() -> None:
    capture = open_room(noise=False, width=640)
    frame, labels, objects = capture[0], capture.labels(0), capture.object_image(0)
    cup = room.CLASSES.index("cup")
    seen = {}
    for name, (x, y, z) in room.CUPS.items():
        outside = np.array([[x - 0.033, y, z + 0.05]])  # the side that faces the camera, which stands at smaller x
        pixel, depth = project(transform(invert(capture.pose(0)), outside), frame.intrinsics)
        u, v = np.rint(pixel[0]).astype(int)
        assert labels[v, u] == cup
        assert frame.depth_m[v, u] == pytest.approx(float(depth[0]), abs=0.02)
        seen[name] = (objects[v, u], frame.color[v, u].astype(int))
    assert seen["red"][0] != seen["yellow"][0]
    r, g, b = seen["red"][1]
    assert r > 2 * g
    assert r > 2 * b
    r, g, b = seen["yellow"][1]
    assert min(r, g) > 2 * b


def test_noise_is_that_of_the_sensor() -> None:
    noisy, exact = open_room(), open_room(noise=False)
    difference, depths, holes = [], [], 0
    for i in range(0, 60, 6):
        a, b = noisy[i].depth_m, exact[i].depth_m
        holes += int(((a == 0) & (b > 0)).sum())
        valid = (a > 0) & (np.abs(a - b) < 0.05)
        difference.append((a - b)[valid])
        depths.append(b[valid])
    difference, depths = np.concatenate(difference), np.concatenate(depths)
    sigma = 0.0012 + 0.0019 * (depths - 0.4) ** 2
    assert np.abs(np.median(difference)) < 1e-3
    assert 0.9 < np.median(np.abs(difference) / sigma) / 0.6745 < 1.4  # jitter on slanted surfaces adds a little
    assert holes > 100


def test_class_images_have_the_frames_size_and_show_only_known_classes() -> None:
    capture = open_room(width=320)
    labels = capture.labels(17)
    assert labels.shape == capture[17].depth_m.shape
    assert labels.max() < len(capture.classes)
    assert (labels > 0).mean() > 0.99


def test_ground_truth_knows_the_floor_the_air_and_what_was_never_seen() -> None:
    truth = open_room(frames=40).ground_truth()
    labels, origin, size = truth["labels"], truth["origin"], truth["voxel_size"]

    def at(x, y, z) -> int:
        return labels[tuple(np.floor((np.array((x, y, z)) - origin) / size).astype(int))]

    assert truth["classes"][at(1.55, 1.2, 0.0)] == "floor"
    assert truth["classes"][at(2.0, 0.7, 0.73)] == "table"
    assert at(1.3, 0.2, 1.2) == FREE
    assert at(-2.3, 1.5, 1.0) == UNKNOWN  # inside the wardrobe
    assert truth["classes"][at(*np.add(room.CUPS["red"], (0, 0, 0.05)))] == "cup"


def test_an_unknown_built_in_name_and_a_bad_size_are_told() -> None:
    with pytest.raises(CaptureError, match="builtin:room"):
        open_capture("builtin:kitchen")
    with pytest.raises(ConfigError, match="frames"):
        open_room(frames=0)
