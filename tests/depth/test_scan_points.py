"""Points of a scan: which are confirmed, and how they are merged in cells."""

import numpy as np
import pytest
from textured import CAMERA, Rectangle, looking, render

from freeocc3d.depth.cross_view_check import DepthImage, confirm_depth
from freeocc3d.depth.scan_points import confirm_points, merge_points

ROOM = [Rectangle((-3, -3, 3.0), (6, 0, 0), (0, 6, 0)), Rectangle((-0.3, -0.4, 1.5), (0.6, 0, 0), (0, 0.8, 0), seed=1)]


def _depth(x: float, scale: float = 1.0) -> DepthImage:
    _, depth = render(ROOM, looking(x, toward=3.0))
    inverse = (1.0 / (depth * scale)).astype(np.float32)
    return DepthImage(inverse, np.full_like(inverse, 1e-3), CAMERA, looking(x, toward=3.0))


def test_points_that_others_confirm_lie_on_the_surfaces() -> None:
    points, sigma_m = confirm_points(_depth(0.0), [_depth(0.3), _depth(-0.3)], agreeing=2)
    assert len(points) > 0.7 * CAMERA.width * CAMERA.height
    off = np.minimum(np.abs(points[:, 2] - 3.0), np.abs(points[:, 2] - 1.5))
    assert np.percentile(off, 99) < 0.02
    assert ((sigma_m > 1e-3) & (sigma_m < 0.1)).all()
    refuted, _ = confirm_points(_depth(0.0, scale=0.9), [_depth(0.3), _depth(-0.3)], agreeing=2)
    assert len(refuted) < 0.05 * len(points)


def _measured(cameras: int, count: int, spread: float = 1.0):
    rng = np.random.default_rng(0)
    return [(rng.uniform(-spread, spread, (count, 3)), rng.uniform(0.001, 0.01, count)) for _ in range(cameras)]


def _plain(measured, edge: float):
    """Cell by cell: points and sigmas of those that two cameras measured, and the rays."""
    cells: dict[tuple[int, ...], list] = {}
    for camera, (points, sigma_m) in enumerate(measured):
        for point, sigma in zip(points, sigma_m, strict=True):
            cells.setdefault(tuple(np.floor(point / edge).astype(int)), []).append((camera, point, sigma))
    points, sigmas, rays = [], [], []
    for _, held in sorted(cells.items()):
        seen = sorted({camera for camera, _, _ in held})
        if len(seen) > 1:
            weights = np.array([1 / sigma**2 for _, _, sigma in held])
            rays += [(len(points), camera) for camera in seen]
            points.append(np.average([p for _, p, _ in held], axis=0, weights=weights))
            sigmas.append(np.average([s for _, _, s in held], weights=weights))
    return np.array(points), np.array(sigmas), rays


def test_cells_hold_the_weighted_means_of_two_cameras_or_more() -> None:
    measured = _measured(5, 300)
    found = merge_points(measured, depth_m=20.0)
    points, sigma_m, rays = _plain(measured, 0.2)
    np.testing.assert_allclose(found.points, points)
    np.testing.assert_allclose(found.sigma_m, sigma_m)
    assert sorted(zip(found.ray_point.tolist(), found.ray_camera.tolist(), strict=True)) == rays
    assert found.cell_m == pytest.approx(0.2)


def test_there_are_no_more_points_than_asked_for() -> None:
    measured = _measured(8, 500)
    found = merge_points(measured, depth_m=5.0, most=100)
    assert 0 < len(found.points) <= 100
    points, sigma_m, rays = _plain(measured, found.cell_m)
    np.testing.assert_allclose(found.points, points)
    np.testing.assert_allclose(found.sigma_m, sigma_m)
    assert sorted(zip(found.ray_point.tolist(), found.ray_camera.tolist(), strict=True)) == rays


def test_what_lies_beyond_all_measure_or_is_nothing_is_left_out() -> None:
    far = np.array([[0.0, 0.0, 0.0], [1e9, 0.0, 0.0]]), np.array([0.01, 0.01])
    assert len(merge_points([far, far], depth_m=1.0).points) == 1
    nothing = np.zeros((0, 3)), np.zeros(0)
    assert len(merge_points([nothing, nothing], depth_m=1.0).points) == 0
    assert len(merge_points([], depth_m=1.0).points) == 0


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_the_first_and_the_last_cell_along_an_axis_hold_points_and_none_lie_beyond(axis: int) -> None:
    """Cells of a centimeter, 2^20 of them along an axis."""
    reach = (1 << 19) * 0.01
    at = np.array((-reach - 0.005, -reach + 0.005, 0.005, reach - 0.005, reach + 0.005))
    points = np.full((5, 3), 0.005)
    points[:, axis] = at
    found = merge_points([(points, np.full(5, 0.01))] * 2, 1.0)
    np.testing.assert_allclose(np.sort(found.points[:, axis]), at[1:4], rtol=1e-9)
    np.testing.assert_allclose(np.delete(found.points, axis, axis=1), 0.005)


@pytest.mark.parametrize(("views", "kept"), [(1, False), (2, True)])
def test_confirmed_points_have_the_mean_depth_and_its_deviation_in_meters(views: int, kept: bool) -> None:
    own, others = _depth(0.0), [_depth(0.2), _depth(-0.2)]
    points, sigma = confirm_points(own, others[:views], agreeing=2)
    assert bool(len(points)) == kept
    if kept:
        T = own.T_world_cam
        z = (points - T[:3, 3]) @ T[:3, 2]
        inverse = confirm_depth(own, others, 0.01).sigma.numpy()
        assert inverse.min() * z.min() ** 2 <= sigma.min() * 1.0001
        flat = np.abs(points[:, 2] - 3.0) < 0.02
        assert flat.mean() > 0.5
        np.testing.assert_allclose(sigma[flat], 9 * np.median(inverse), rtol=0.3)
