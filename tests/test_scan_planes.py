import numpy as np
from numpy.testing import assert_allclose

from freeocc3d.tracking.stereo.consistency import DepthImage
from freeocc3d.tracking.stereo.scan_planes import find_planes, patches, scan_planes, snapped
from freeocc3d.types import Intrinsics

CAMERA = Intrinsics(160, 120, 130.0, 130.0, 79.5, 59.5)
FLOOR = np.array((0.0, 0.8, 0.6))  # FLOOR · X = 1.2 metres
HEIGHT = 1.2
NOISE = 0.004


def _turned(yaw: float, x: float) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = [[np.cos(yaw), 0, np.sin(yaw)], [0, 1, 0], [-np.sin(yaw), 0, np.cos(yaw)]]
    T[0, 3] = x
    return T


def _inverse(T: np.ndarray) -> np.ndarray:
    """Of the floor, 0 where a pixel looks past it."""
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    seen = np.stack(((u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones(u.shape)), axis=-1)
    return np.maximum(seen @ (FLOOR @ T[:3, :3]) / (HEIGHT - FLOOR @ T[:3, 3]), 0.0)


def _views(seed: int = 0) -> list[DepthImage]:
    rng = np.random.default_rng(seed)
    views = []
    for yaw, x in ((0.0, 0.0), (0.2, -0.3), (-0.2, 0.3)):
        T = _turned(yaw, x)
        inverse = _inverse(T) * (1 + NOISE * rng.standard_normal((CAMERA.height, CAMERA.width)))
        views.append(DepthImage(inverse.astype(np.float32), (NOISE * inverse + 1e-4).astype(np.float32), CAMERA, T))
    return views


def test_patches_of_a_plane_have_its_normal() -> None:
    points, normals, z = patches(_views()[1], 500)
    assert len(points) > 100
    assert_allclose(points @ FLOOR, HEIGHT, atol=0.02)
    assert np.median(np.abs(normals @ FLOOR)) > 0.99
    assert (z > 0).all()


def test_the_views_share_one_plane() -> None:
    (plane,) = scan_planes(_views(), 5)
    assert abs(plane.normal @ FLOOR) > 0.9999
    assert_allclose(abs(plane.offset), HEIGHT, atol=0.003)
    assert plane.sigma_m < 0.01


def test_a_plane_ends_where_nothing_was_measured() -> None:
    (plane,) = scan_planes(_views(), 5)
    ahead, far_aside = np.array((0.0, 0.0, 1.0)), np.array((100.0, 0.0, 1.0))
    times, there = plane.met(np.zeros(3), np.stack((ahead, far_aside, -ahead)))
    assert_allclose(times[0], HEIGHT / FLOOR[2], rtol=0.01)
    assert there.tolist() == [True, False, False]


def test_what_cannot_be_told_from_the_plane_moves_to_it() -> None:
    views = _views()
    depth = views[0]
    depth.inverse[50:60, 70:80] *= 1.5  # a thing before it
    depth.inverse[80:90, 70:80] = 0.0  # nothing measured
    found = snapped(depth, scan_planes(views, 5), 1e-4)
    assert_allclose(found.inverse[50:60, 70:80], depth.inverse[50:60, 70:80])
    assert (found.inverse[80:90, 70:80] == 0).all()
    true, there = _inverse(depth.T_world_cam), depth.inverse > 0
    there[50:60, 70:80] = False
    before, after = (np.abs(image - true)[there & (true > 0.3)] for image in (depth.inverse, found.inverse))
    assert np.median(after) < 0.6 * np.median(before)
    assert (found.sigma <= depth.sigma + 1e-7).all()


def test_no_plane_in_clutter() -> None:
    rng = np.random.default_rng(0)
    normals = rng.standard_normal((2000, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    assert find_planes(rng.uniform(-2, 2, (2000, 3)), normals, 2.0, 5) == []


def test_nothing_measured() -> None:
    empty = DepthImage(np.zeros((120, 160), np.float32), np.ones((120, 160), np.float32), CAMERA, np.eye(4))
    assert scan_planes([empty], 5) == []


def test_points_strewn_over_kilometres_take_no_memory() -> None:
    points = np.random.default_rng(0).uniform(-5000.0, 5000.0, (2000, 3)) * (1.0, 1.0, 0.0)
    assert find_planes(points, np.tile((0.0, 0.0, 1.0), (2000, 1)), 1.0, 5) == []
