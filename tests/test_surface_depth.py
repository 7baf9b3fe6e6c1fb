"""Depth of a view from a surface, and from planes where the surface only spans a gap."""

import numpy as np
import pytest
from textured import CAMERA, looking

from freeocc3d.tracking.stereo.surface_depth import surface_depth
from freeocc3d.tracking.stereo.watertight import Surface

_DEEP = 2.0


def _wall(cell: float) -> Surface:
    """The wall at z = 2 m: to the left in small triangles, to the right of x = 0 in large ones."""
    vertices: list[tuple[float, float, float]] = []
    triangles = []
    for x0, x1, step in ((-3.0, 0.0, cell), (0.0, 3.0, 1.0)):
        for x in np.arange(x0, x1 - 1e-6, step):
            for y in np.arange(-1.0, 2.0 - 1e-6, step):
                k = len(vertices)
                vertices += [(x, y, _DEEP), (x + step, y, _DEEP), (x + step, y + step, _DEEP), (x, y + step, _DEEP)]
                triangles += [(k, k + 1, k + 2), (k, k + 2, k + 3)]
    return Surface(np.array(vertices, np.float32), np.full(len(vertices), 0.01, np.float32),
                   np.array(triangles, np.int32), cell)  # fmt: skip


class Plane:
    """One at a depth of a camera that looks along z."""

    def __init__(self, depth: float):
        self.depth = depth

    def nearest(self, origin, directions, least_times):
        return np.where(self.depth >= least_times, self.depth, 0.0)


_LEFT, _RIGHT = (slice(20, 110), slice(5, 75)), (slice(20, 110), slice(85, 155))


def test_what_was_measured_is_shown_and_gaps_are_left_empty() -> None:
    found = surface_depth(_wall(0.05), None, CAMERA, np.eye(4))
    np.testing.assert_allclose(found.inverse[_LEFT], 1.0 / _DEEP, rtol=1e-5)
    np.testing.assert_allclose(found.sigma[_LEFT], 0.01 / _DEEP**2, rtol=1e-5)
    assert not found.inverse[_RIGHT].any()
    assert not surface_depth(_wall(0.05), None, CAMERA, np.diag((1.0, -1.0, -1.0, 1.0))).inverse.any()


@pytest.mark.parametrize(("plane", "taken"), [(1.9, False), (1.97, True), (2.15, True), (2.3, False)])
def test_planes_near_the_surface_fill_its_gaps(plane: float, taken: bool) -> None:
    found = surface_depth(_wall(0.05), Plane(plane), CAMERA, np.eye(4))
    np.testing.assert_allclose(found.inverse[_LEFT], 1.0 / _DEEP, rtol=1e-5)
    np.testing.assert_allclose(found.inverse[_RIGHT], 1.0 / plane if taken else 0.0, rtol=1e-5)
    if taken:
        np.testing.assert_allclose(found.sigma[_RIGHT], 0.01 / plane, rtol=1e-5)


def test_no_surface_no_depth() -> None:
    empty = Surface(np.zeros((0, 3), np.float32), np.zeros(0, np.float32), np.zeros((0, 3), np.int32), 0.01)
    assert not surface_depth(empty, Plane(2.0), CAMERA, looking(0.3)).inverse.any()
