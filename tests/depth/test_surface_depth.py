"""Depth of a view from a surface, or from planes where the surface only spans a gap."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from textured import CAMERA, looking

from freeocc3d.depth.building_planes import Layout, Plane
from freeocc3d.depth.cross_view_check import DepthImage
from freeocc3d.depth.surface_depth import prefer_own_depth, render_surface_depth
from freeocc3d.depth.watertight_surface import WatertightSurface

_DEEP = 2.0


def _wall(cell: float) -> WatertightSurface:
    """The wall at z = 2 m: to the left in small triangles, to the right of x = 0 in large ones."""
    vertices: list[tuple[float, float, float]] = []
    triangles = []
    for x0, x1, step in ((-3.0, 0.0, cell), (0.0, 3.0, 1.0)):
        for x in np.arange(x0, x1 - 1e-6, step):
            for y in np.arange(-1.0, 2.0 - 1e-6, step):
                k = len(vertices)
                vertices += [(x, y, _DEEP), (x + step, y, _DEEP), (x + step, y + step, _DEEP), (x, y + step, _DEEP)]
                triangles += [(k, k + 1, k + 2), (k, k + 2, k + 3)]
    return WatertightSurface(np.array(vertices, np.float32), np.full(len(vertices), 0.01, np.float32),
                   np.array(triangles, np.int32), cell)  # fmt: skip


def _layout(depth: float) -> Layout:
    """A plane across the view of a camera that looks along z."""
    return Layout([Plane(np.eye(3)[2], depth, np.eye(3)[:2], np.full(2, -5.0), 0.5, np.ones((20, 20), bool), True)])


_LEFT, _RIGHT = (slice(20, 110), slice(5, 75)), (slice(20, 110), slice(85, 155))


def test_what_was_measured_is_shown_and_large_gaps_are_left_empty() -> None:
    found = render_surface_depth(_wall(0.03), Layout([]), CAMERA, np.eye(4))
    np.testing.assert_allclose(found.inverse[_LEFT], 1.0 / _DEEP, rtol=1e-5)
    np.testing.assert_allclose(found.sigma[_LEFT], 0.01 / _DEEP**2, rtol=1e-5)
    assert not found.inverse[_RIGHT].any()
    assert not render_surface_depth(_wall(0.03), Layout([]), CAMERA, np.diag((1.0, -1.0, -1.0, 1.0))).inverse.any()


@pytest.mark.parametrize(("plane", "taken"), [(1.9, False), (1.97, True), (2.15, True), (2.3, False)])
def test_planes_near_the_surface_fill_its_gaps(plane: float, taken: bool) -> None:
    found = render_surface_depth(_wall(0.03), _layout(plane), CAMERA, np.eye(4))
    np.testing.assert_allclose(found.inverse[_LEFT], 1.0 / _DEEP, rtol=1e-5)
    np.testing.assert_allclose(found.inverse[_RIGHT], 1.0 / plane if taken else 0.0, rtol=1e-5)
    if taken:
        np.testing.assert_allclose(found.sigma[_RIGHT], 0.01 / plane, rtol=1e-5)


def test_small_gaps_are_shown_as_guesses_unless_they_are_seen_edge_on() -> None:
    found = render_surface_depth(_wall(0.05), Layout([]), CAMERA, np.eye(4))
    np.testing.assert_allclose(found.inverse[_RIGHT], 1.0 / _DEEP, rtol=1e-5)
    np.testing.assert_allclose(found.sigma[_RIGHT], 0.04 / _DEEP, rtol=1e-5)
    found = render_surface_depth(_wall(0.05), _layout(1.97), CAMERA, np.eye(4))  # planes are surer
    np.testing.assert_allclose(found.inverse[_RIGHT], 1.0 / 1.97, rtol=1e-5)
    along = np.eye(4)
    along[:3, :3] = Rotation.from_euler("y", 89.0, degrees=True).as_matrix()
    along[:3, 3] = 0.1, 0.5, 1.5
    center = (slice(50, 65), slice(30, 50))  # toward the right part, at a cosine of at most 0.4
    assert render_surface_depth(_wall(0.8), Layout([]), CAMERA, along).inverse[center].all()
    assert not render_surface_depth(_wall(0.05), Layout([]), CAMERA, along).inverse[center].any()


def test_no_surface_no_depth() -> None:
    empty = WatertightSurface(np.zeros((0, 3), np.float32), np.zeros(0, np.float32), np.zeros((0, 3), np.int32), 0.01)
    assert not render_surface_depth(empty, _layout(2.0), CAMERA, looking(0.3)).inverse.any()


@pytest.mark.parametrize(("columns", "kept"), [(6, True), (16, False)])
def test_own_depth_stays_where_a_surface_lacks_most_of_it(columns: int, kept: bool) -> None:
    """columns: of 20 in which the surface lies where the view measured it."""
    sigma = np.full((4, 20), 0.01, np.float32)
    own = DepthImage(np.full((4, 20), 0.5, np.float32), sigma, CAMERA, np.eye(4))
    lying = np.where(np.arange(20) < columns, np.float32(0.51), np.float32(0)) * np.ones((4, 1), np.float32)
    found = prefer_own_depth(own, DepthImage(lying, sigma, CAMERA, np.eye(4)))
    np.testing.assert_array_equal(found.inverse[:, :columns], np.float32(0.5))
    np.testing.assert_array_equal(found.inverse[:, columns:], np.float32(0.5 if kept else 0))
