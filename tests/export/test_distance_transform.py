"""Exact distances against SciPy's, and against solids with known distances."""

import numpy as np
import pytest

from freeocc3d.export.distance_transform import transform_signed, transform_signed_reference


@pytest.mark.parametrize("share", [0.5, 0.05, 0.002, 0.0, 1.0])
@pytest.mark.parametrize("shape", [(7, 1, 9), (13, 11, 5), (40, 30, 20), (1, 1, 1), (1, 300, 2)])
def test_distances_are_those_of_the_reference(share, shape) -> None:
    inside = np.random.default_rng(1).random(shape) < share
    np.testing.assert_array_equal(transform_signed(inside), transform_signed_reference(inside))


def test_an_array_of_any_layout_is_understood() -> None:
    inside = np.random.default_rng(2).random((9, 8, 7)) < 0.2
    np.testing.assert_array_equal(
        transform_signed(inside.transpose(2, 0, 1)), transform_signed(inside).transpose(2, 0, 1)
    )
    np.testing.assert_array_equal(transform_signed(inside[::2, 1:]), transform_signed_reference(inside[::2, 1:]))


def test_a_box_has_its_distances_inside_and_outside() -> None:
    low, high = np.array((6, 9, 4)), np.array((17, 15, 20))
    at = np.stack(np.indices((24, 26, 28)), axis=-1)
    inside = ((at >= low) & (at < high)).all(axis=-1)
    outside = np.sqrt((np.maximum(np.maximum(low - at, at - high + 1), 0) ** 2).sum(axis=-1))
    within = np.minimum(at - low + 1, high - at).min(axis=-1)
    np.testing.assert_allclose(transform_signed(inside), np.where(inside, -within, outside), rtol=1e-6)


def test_a_sphere_has_its_distances_to_half_a_voxels_diagonal() -> None:
    center, radius = np.array((20.3, 19.6, 21.1)), 11.7
    at = np.stack(np.indices((41, 42, 43)), axis=-1)
    analytic = np.linalg.norm(at - center, axis=-1) - radius
    found = transform_signed(analytic <= 0)
    assert (np.sign(found) == np.where(analytic <= 0, -1, 1)).all()
    # The nearest center on the other side lies beyond the surface, by at most a voxel's diagonal.
    beyond = np.abs(found) - np.abs(analytic)
    assert beyond.min() > -1e-5
    assert beyond.max() < np.sqrt(3)


def test_far_distances_are_exact() -> None:
    inside = np.zeros((1, 2, 20_000), bool)
    inside[0, 0, 0] = True
    assert transform_signed(inside)[0, 1, -1] == np.float32(np.sqrt(19_999.0**2 + 1))
