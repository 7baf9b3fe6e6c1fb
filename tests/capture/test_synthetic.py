"""The built-in room: the same frame at every request, exact or with the noise of a sensor."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np
import pytest

from freeocc3d.capture import base, open_capture
from freeocc3d.capture.builtin import builtin_room
from freeocc3d.capture.readers import synthetic
from freeocc3d.core.depth_sensors import STRUCTURED_LIGHT
from freeocc3d.core.errors import CaptureError, ConfigError
from freeocc3d.core.transforms import back_project, invert, is_rigid, project, transform
from freeocc3d.core.types import FREE, UNKNOWN, Frame

CUP = builtin_room.CLASSES.index("cup")
FLOOR = builtin_room.CLASSES.index("floor")


def reader(options: base.Options | None = None, **own) -> synthetic.Reader:
    own = {"width": 160, "height": 120, **own}
    return synthetic.Reader(Path(synthetic.PATH), options or base.Options(), synthetic.Options(**own))


@pytest.fixture(scope="module")
def noisy() -> synthetic.Reader:
    return reader()


@pytest.fixture(scope="module")
def exact() -> synthetic.Reader:
    return reader(noise=False)


@pytest.fixture(scope="module")
def truth() -> dict:
    return reader(width=120, height=90, frames=60).ground_truth(0.08)


def same(a: Frame, b: Frame) -> bool:
    return np.array_equal(a.color, b.color) and np.array_equal(a.depth_m, b.depth_m)


def surface_points(capture: synthetic.Reader, index: int) -> np.ndarray:
    """(H, W, 3) world points of a frame's exact depth."""
    v, u = np.mgrid[: capture.camera.height, : capture.camera.width]
    pixels = np.stack((u, v), axis=-1).astype(np.float64)
    return transform(capture.pose(index), back_project(pixels, capture.exact_depth(index), capture.camera))


def cup_pixel(capture: synthetic.Reader, name: str, index: int) -> tuple[int, int]:
    """Row and column at which the middle of a cup appears."""
    middle = np.array(builtin_room.CUPS[name]) + (0, 0, builtin_room.CUP_HEIGHT / 2)
    (u, v), _ = project(transform(invert(capture.pose(index)), middle), capture.camera)
    return round(float(v)), round(float(u))


def test_a_frame_keeps_the_contract(noisy) -> None:
    frame, labels = noisy[7], noisy.labels(7)
    assert frame.color.shape == (120, 160, 3)
    assert frame.depth_m.shape == labels.shape == (120, 160)
    assert (frame.color.dtype, frame.depth_m.dtype, labels.dtype) == (np.uint8, np.float32, np.uint8)
    assert (frame.index, frame.timestamp, frame.intrinsics) == (7, noisy.timestamps[7], noisy.intrinsics)
    assert noisy.classes[0] == "nothing"
    assert labels.max() < len(noisy.classes)
    assert len(noisy) == len(noisy.timestamps) == 240


def test_it_is_opened_by_its_name() -> None:
    capture = open_capture("builtin:room", base.Options(), {"synthetic": {"frames": 5, "width": 16, "height": 12}})
    assert isinstance(capture, synthetic.Reader)
    assert len(capture) == 5
    assert not synthetic.Reader.recognizes(Path("builtin:room"))


def test_what_is_not_there_is_refused() -> None:
    with pytest.raises(CaptureError, match="builtin:room"):
        synthetic.Reader(Path("builtin:castle"), base.Options(), synthetic.Options())
    with pytest.raises(ConfigError, match="frames"):
        synthetic.Options(frames=0)
    for index in (-1, 240):
        with pytest.raises(IndexError):
            reader()[index]


def test_a_frame_does_not_depend_on_what_was_asked_before(noisy) -> None:
    order = [30, 3, 30, 110]
    again = reader()
    first = {i: noisy[i] for i in order}
    assert all(same(first[i], again[i]) for i in reversed(order))
    assert not same(first[30], reader(seed=1)[30])


def test_threads_get_the_same_frames(noisy) -> None:
    fresh = reader()
    with ThreadPoolExecutor(4) as pool:
        frames = list(pool.map(fresh.__getitem__, range(0, 80, 10)))
    assert all(same(frame, noisy[frame.index]) for frame in frames)


@pytest.mark.parametrize(
    ("shape", "volume"),
    [
        (builtin_room.box((0, 0, 0), (1, 2, 3)), 6.0),
        (builtin_room.lathe((3, 1), [(0, 0), (0.5, 0), (0.5, 2), (0, 2)], 200), np.pi * 0.25 * 2),
    ],
)
def test_triangles_face_outwards_and_none_is_degenerate(shape: np.ndarray, volume: float) -> None:
    a, b, c = shape.transpose(1, 0, 2)
    assert np.einsum("ni,ni->n", a, np.cross(b, c)).sum() / 6 == pytest.approx(volume, rel=1e-3)
    assert (np.linalg.norm(np.cross(b - a, c - a), axis=1) > 0).all()


def test_the_room_is_furnished_and_the_walk_sees_all_of_it() -> None:
    capture = reader(width=80, height=60)
    names = capture.objects
    assert len(names) >= 12
    assert len(set(names)) >= 8
    assert names.count("cup") == 2
    assert names.count("chair") == 3
    assert set(names) == set(builtin_room.CLASSES[1:])
    pixels = np.zeros(len(names), int)
    for index in range(0, len(capture), 8):
        image = capture.object_image(index)
        pixels = np.maximum(pixels, np.bincount(image[image >= 0], minlength=len(names)))
    assert pixels.min() >= 15


@pytest.mark.parametrize("index", [0, 15, 225])
def test_the_cups_are_red_and_yellow_and_where_they_are_said_to_be(noisy, index: int) -> None:
    colors, objects = {}, {}
    for name in builtin_room.CUPS:
        row, column = cup_pixel(noisy, name, index)
        assert noisy.labels(index)[row, column] == CUP
        colors[name] = noisy[index].color[row, column].astype(int)
        objects[name] = noisy.object_image(index)[row, column]
    red, yellow = colors["red"], colors["yellow"]
    assert red[0] > 120
    assert red[1] < 0.4 * red[0]
    assert yellow[1] > 0.65 * yellow[0]
    assert yellow[2] < 0.4 * yellow[0]
    assert objects["red"] != objects["yellow"]


def test_the_cups_stand_a_hand_apart_and_are_seen_from_near(noisy) -> None:
    red, yellow = (np.array(builtin_room.CUPS[name]) for name in ("red", "yellow"))
    assert np.linalg.norm(red - yellow) == pytest.approx(0.12)
    assert np.linalg.norm(noisy.pose(0)[:3, 3] - red) < 1.5


def test_exact_depth_is_that_of_the_planes(exact) -> None:
    for index in (50, 130, 200):
        labels, points, T = exact.labels(index), surface_points(exact, index), exact.pose(index)
        np.testing.assert_allclose(points[labels == FLOOR][:, 2], 0, atol=1e-5)
        v, u = np.nonzero(labels == FLOOR)
        directions = back_project(np.stack((u, v), axis=-1), np.ones(len(u)), exact.camera) @ T[:3, :3].T
        np.testing.assert_allclose(exact[index].depth_m[v, u], -T[2, 3] / directions[:, 2], rtol=1e-5)
        inside = (
            np.abs(points)
            <= np.array((builtin_room.SIZE[0] / 2, builtin_room.SIZE[1] / 2, builtin_room.SIZE[2])) + 1e-5
        )
        assert inside.all()


def test_a_point_looks_the_same_from_elsewhere(exact) -> None:
    points = surface_points(exact, 40).reshape(-1, 3)
    pixels, z = project(transform(invert(exact.pose(46)), points), exact.camera)
    u, v = np.rint(np.nan_to_num(pixels, nan=-1)).astype(int).T
    inside = (u >= 0) & (u < 160) & (v >= 0) & (v < 120)
    u, v, z = u[inside], v[inside], z[inside]
    visible = np.abs(exact[46].depth_m[v, u] - z) < 0.01
    before = exact[40].color.reshape(-1, 3)[inside][visible].astype(int)
    after = exact[46].color[v, u][visible].astype(int)
    assert visible.sum() > 5000
    assert np.median(np.abs(before - after)) <= 5


def test_the_walk_is_rigid_closed_and_slow(noisy) -> None:
    poses = np.array([noisy.pose(i) for i in range(len(noisy))])
    assert all(is_rigid(T, 1e-9) for T in poses)
    steps = invert(np.roll(poses, 1, axis=0)) @ poses  # the first one closes the loop
    angles = np.degrees(np.arccos(np.clip((np.trace(steps[:, :3, :3], axis1=1, axis2=2) - 1) / 2, -1, 1)))
    lengths = np.linalg.norm(steps[:, :3, 3], axis=1)
    assert lengths.max() < 0.03
    assert angles.max() < 2.2
    assert np.median(angles) < 2.0
    assert np.ptp(poses[:, :2, 3], axis=0).min() > 1.5  # it goes round, it does not turn on the spot


def test_fewer_frames_are_the_same_walk_made_faster() -> None:
    np.testing.assert_allclose(reader(frames=60).pose(15), reader(frames=240).pose(60))


def test_noise_is_that_of_the_model() -> None:
    rng = np.random.default_rng(3)
    for distance in (0.8, 2.0, 4.0):
        plane = np.full((100, 100), distance, np.float32)
        noisy = synthetic.disturbed_depth(plane, np.ones_like(plane), rng)
        sigma = 0.0012 + 0.0019 * (distance - 0.4) ** 2
        assert noisy.std() == pytest.approx(np.hypot(sigma, 0.001 / np.sqrt(12)), rel=0.05)
        assert noisy.mean() == pytest.approx(distance, abs=5 * sigma / 100)
        np.testing.assert_allclose(noisy * 1000, np.rint(noisy * 1000), atol=1e-3)


def test_a_frames_depth_has_that_noise(noisy, exact) -> None:
    ratios, holes = [], 0
    for index in range(0, 60, 6):
        measured, true = noisy[index].depth_m, exact[index].depth_m
        holes += np.count_nonzero((measured == 0) & (true > 0))
        near = (measured > 0) & (np.abs(measured - true) < 0.05)
        ratios.append(((measured - true) / STRUCTURED_LIGHT.compute_sigma(true))[near])
    ratio = np.concatenate(ratios)
    assert abs(np.median(ratio)) < 0.05
    assert np.median(np.abs(ratio)) == pytest.approx(0.6745, rel=0.1)  # that of a unit normal distribution
    assert holes > 100


def test_depth_has_holes_at_edges_at_grazing_incidence_and_up_close() -> None:
    depth, cosine = np.full((60, 60), 2.0, np.float32), np.ones((60, 60), np.float32)
    depth[:, 30:], cosine[:10], depth[50:] = 3.0, 0.05, 0.2
    lost = synthetic.disturbed_depth(depth, cosine, np.random.default_rng(0)) == 0
    assert lost[:10].mean() > 0.95
    assert lost[52:].all()
    assert 0.3 < lost[12:48, 29:31].mean() < 0.7
    assert not lost[12:48, :29].any()


def test_nothing_is_measured_beyond_the_range() -> None:
    capture = reader(base.Options(max_depth=2.0))
    assert 1.9 < capture[20].depth_m.max() <= 2.0
    assert capture.exact_depth(20).max() > 2.0


def test_stated_intrinsics_replace_the_cameras(noisy) -> None:
    capture = reader(base.Options(intrinsics=(100.0, 101.0, 80.0, 60.0)))
    assert capture[3].intrinsics.fy == 101.0
    assert same(capture[3], noisy[3])


def test_truth_has_surfaces_air_and_the_unseen(truth) -> None:
    labels, origin, voxel_size = truth["labels"], truth["origin"], truth["voxel_size"]
    assert list(truth["classes"]) == list(builtin_room.CLASSES)
    assert labels.dtype == np.uint8

    def at(x: float, y: float, z: float) -> int:
        return int(labels[tuple(np.floor((np.array((x, y, z)) - origin) / voxel_size).astype(int))])

    assert at(0.6, -1.2, 0.0) == FLOOR
    assert at(0.0, 0.0, 1.3) == FREE
    assert at(2.1, 0.25, 0.73) == builtin_room.CLASSES.index("table")
    assert at(0.1, 1.97, 0.84) == builtin_room.CLASSES.index("sofa")
    assert at(2.6, -0.9, 1.2) == builtin_room.CLASSES.index("wall")
    assert at(-2.3, 1.4, 1.0) == UNKNOWN  # inside the wardrobe
    assert at(*(np.array(builtin_room.CUPS["red"]) + (0, 0, 0.05))) == CUP
    assert set(np.unique(labels)) == {*range(len(builtin_room.CLASSES)), UNKNOWN}


def test_truth_agrees_with_what_the_images_show(truth) -> None:
    capture = reader(width=120, height=90, frames=60)
    shape, agreed, total = truth["labels"].shape, 0, 0
    for index in (0, 20, 40):
        voxels = np.floor((surface_points(capture, index) - truth["origin"]) / truth["voxel_size"]).astype(int)
        assert ((voxels >= 0) & (voxels < shape)).all()
        seen = truth["labels"][tuple(np.moveaxis(voxels, -1, 0))]
        assert np.mean((seen != FREE) & (seen != UNKNOWN)) > 0.99
        agreed, total = agreed + np.count_nonzero(seen == capture.labels(index)), total + seen.size
    assert agreed / total > 0.93


@pytest.mark.parametrize("facing", [False, True])
def test_points_that_a_depth_image_does_not_hide_are_those_of_a_plain_computation(facing: bool) -> None:
    rng = np.random.default_rng(0)
    height, width, focal = 24, 32, 30.0
    K = np.array(((focal, 0, 15.7), (0, focal, 11.2), (0, 0, 1)))
    T_cam_world = np.eye(4)
    T_cam_world[:3, :3] = cv2.Rodrigues(np.array((0.3, -0.2, 0.1)))[0]
    T_cam_world[:3, 3] = (0.1, 0.2, -0.3)
    depth = rng.uniform(1.0, 3.0, (height, width)).astype(np.float32)
    depth[rng.random(depth.shape) < 0.2] = 0
    points = rng.uniform(-3.0, 3.0, (20_000, 3)).astype(np.float32)
    normals = rng.standard_normal((20_000 if facing else 0, 3)).astype(np.float32)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    known = rng.random(len(points)) < 0.1
    seen = known.copy()
    synthetic._mark_seen(points, normals, T_cam_world, K, depth, seen)

    p = points.astype(float) @ T_cam_world[:3, :3].T + T_cam_world[:3, 3]
    column, row = np.rint(p[:, :2] / p[:, 2:] * focal + K[:2, 2]).astype(int).T
    inside = (p[:, 2] > 0) & (column >= 0) & (row >= 0) & (column < width) & (row < height)
    measured = depth[np.where(inside, row, 0), np.where(inside, column, 0)]
    tolerance = np.zeros(len(points))
    if facing:
        cosine = -(p * (normals @ T_cam_world[:3, :3].T)).sum(axis=1) / np.linalg.norm(p, axis=1)
        inside &= cosine > 0
        tolerance = 0.75 * p[:, 2] / focal / np.maximum(cosine, 0.1)
    expected = known | (inside & (measured > 0) & (p[:, 2] <= measured + tolerance))
    np.testing.assert_array_equal(seen, expected)
    assert (expected & ~known).sum() > 50
    assert (inside & ~expected).sum() > 50


def test_truth_is_of_the_used_frames_only(truth) -> None:
    few = reader(base.Options(stop=2), width=120, height=90, frames=60).ground_truth(0.08)["labels"]
    assert few.shape == truth["labels"].shape
    assert 0 < np.count_nonzero(few != UNKNOWN) < 0.4 * np.count_nonzero(truth["labels"] != UNKNOWN)
