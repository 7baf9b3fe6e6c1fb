"""The lattice of voxels puts the floor, and walls where they allow it, inside layers."""

import numpy as np
import pytest

from freeocc3d.tracking.upright.lattice import find_lattice_origin
from freeocc3d.tracking.upright.surface_patches import SurfacePatches


def walls(*places: tuple[int, float]) -> SurfacePatches:
    """Walls across an axis at a place, with noise of 3 mm."""
    rng = np.random.default_rng(0)
    points, normals = rng.uniform(-3, 3, (len(places), 500, 3)), np.zeros((len(places), 500, 3))
    for n, (axis, place) in enumerate(places):
        points[n, :, axis] = place + rng.normal(0, 0.003, 500)
        normals[n, :, axis] = (-1) ** n
    return SurfacePatches(points.reshape(-1, 3), normals.reshape(-1, 3))


def inside(origin: float, place: float, size: float) -> float:
    """How far a place is from the nearest face, in voxels."""
    share = (place - origin) / size % 1
    return min(share, 1 - share)


@pytest.mark.parametrize("size", [0.04, 0.08, 0.1])
def test_floor_and_walls_lie_inside_layers(size) -> None:
    origin = find_lattice_origin(walls((0, 1.234), (1, -2.0)), size)
    assert (origin >= -size).all()
    assert (origin < 0).all()
    assert all(inside(origin[2], 0.0, size / 2**level) == pytest.approx(1 / 3) for level in range(4))
    assert inside(origin[0], 1.234, size) > 0.4
    assert inside(origin[1], -2.0, size) > 0.4


def test_two_walls_share_a_lattice() -> None:
    origin = find_lattice_origin(walls((0, 0.0), (0, 1.01)), 0.04)  # a quarter of a voxel apart
    assert min(inside(origin[0], place, 0.04) for place in (0.0, 1.01)) > 0.3


def test_without_walls_the_origin_is_the_middle_of_a_voxel() -> None:
    np.testing.assert_allclose(find_lattice_origin(walls(), 0.08), (-0.04, -0.04, -0.08 / 3))
