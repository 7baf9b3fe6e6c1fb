"""The projection against its plain reference and against cases whose answers are known."""

import numpy as np
import pytest
from scenes import gaussians, random_gaussians

from freeocc3d.occupancy import grid, splat
from freeocc3d.types import Gaussians

V = 0.08
LOCAL = np.stack((np.arange(512) // 64, np.arange(512) // 8 % 8, np.arange(512) % 8), axis=1)


def project(g: Gaussians, origin=(0.0, 0.0, 0.0), cutoff: float = 3.0):
    """Bins, block keys, probabilities (B, 512) and voxel centres (B * 512, 3)."""
    origin = np.asarray(origin, float)
    bins = splat.bin_gaussians(g, origin, V, cutoff)
    keys = grid.unpack(bins.packed)
    centers = origin + ((keys[:, None] * 8 + LOCAL).reshape(-1, 3) + 0.5) * V
    return bins, keys, splat.probability(bins, keys), centers


def alpha_at(g: Gaussians, point) -> float:
    _, _, alpha, centers = project(g)
    return float(alpha.reshape(-1)[np.linalg.norm(centers - point, axis=1).argmin()])


def test_gaussian_in_the_middle_of_a_voxel_is_certain_there_and_falls_off_as_its_equation_says() -> None:
    center = np.array([0.5, 0.5, 0.5]) * V
    g = gaussians(center, 0.04)
    assert alpha_at(g, center) == pytest.approx(1.0)
    assert alpha_at(g, center + (V, 0, 0)) == pytest.approx(np.exp(-0.5 * (V / 0.04) ** 2), rel=1e-4)
    assert alpha_at(g, center + (V, V, 0)) == pytest.approx(np.exp(-((V / 0.04) ** 2)), rel=1e-4)


def test_two_gaussians_compose_by_probabilistic_exclusion_and_opacity_has_no_part_in_it() -> None:
    center = np.array([0.5, 0.5, 0.5]) * V
    means = np.stack((center - (0.03, 0, 0), center + (0.05, 0, 0)))
    a, b = np.exp(-0.5 * (0.03 / 0.04) ** 2), np.exp(-0.5 * (0.05 / 0.04) ** 2)
    for opacities in ((1.0, 1.0), (0.1, 0.7)):
        assert alpha_at(gaussians(means, 0.04, opacities=opacities), center) == pytest.approx(
            1 - (1 - a) * (1 - b), rel=1e-4
        )


def test_a_rotated_gaussian_reaches_along_its_long_axis() -> None:
    # Long axis x, turned by 90 degrees about z: it now lies along y.
    quarter = [np.sqrt(0.5), 0, 0, np.sqrt(0.5)]
    center = np.array([0.5, 0.5, 0.5]) * V
    g = gaussians(center, (0.08, 0.02, 0.02), quarter)
    assert alpha_at(g, center + (0, V, 0)) == pytest.approx(np.exp(-0.5), rel=1e-3)
    assert alpha_at(g, center + (V, 0, 0)) == pytest.approx(0.0, abs=1e-3)


@pytest.mark.parametrize("origin", [(0, 0, 0), (0.013, -0.021, 0.3)])
def test_probability_equals_the_reference_on_random_gaussians(origin) -> None:
    g = random_gaussians(400, seed=1)
    _, _, alpha, centers = project(g, origin)
    expected = splat.probability_reference(g, centers, cutoff=3.0)
    np.testing.assert_allclose(alpha.reshape(-1), expected, atol=2e-6)
    assert expected.max() > 0.9


def test_what_the_cutoff_leaves_out_is_as_small_as_stated() -> None:
    g = random_gaussians(30, seed=2, extent=3.0)
    _, _, alpha, centers = project(g, cutoff=3.0)
    whole = splat.probability_reference(g, centers)
    neighbours_left_out = 1.0 - (1.0 - np.exp(-4.5)) ** len(g)
    assert np.abs(alpha.reshape(-1) - whole).max() <= neighbours_left_out


def test_every_voxel_that_a_gaussian_reaches_lies_in_a_block() -> None:
    g = random_gaussians(50, seed=3)
    bins, keys, _, _ = project(g)
    around = np.unique(np.floor(g.means / (8 * V)).astype(int), axis=0)
    found = {tuple(key) for key in keys.tolist()}
    assert {tuple(key) for key in around.tolist()} <= found
    assert bins.start[-1] == len(bins.gaussian)
    assert (np.diff(bins.start) > 0).all()


def test_posterior_mean_equals_the_reference() -> None:
    g = random_gaussians(300, seed=4)
    bins, keys, alpha, centers = project(g)
    wanted = alpha > 0.3
    slots = np.full(alpha.shape, -1, np.int32)
    slots[wanted] = np.arange(wanted.sum())
    values = np.random.default_rng(5).normal(size=(len(g), 9)).astype(np.float32)
    mean = splat.posterior_mean(bins, keys, slots, values)
    expected = splat.posterior_mean_reference(g, centers[wanted.reshape(-1)], values, cutoff=3.0)
    np.testing.assert_allclose(mean, expected, atol=2e-5)


def test_posterior_prefers_the_narrow_the_near_and_the_opaque() -> None:
    center = np.array([0.5, 0.5, 0.5]) * V
    g = gaussians([center, center + (0.03, 0, 0)], [[0.02] * 3, [0.06] * 3], opacities=(0.5, 1.0))
    bins, keys, alpha, centers = project(g)
    slots = np.full(alpha.shape, -1, np.int32)
    slots.reshape(-1)[np.linalg.norm(centers - center, axis=1).argmin()] = 0
    mean = splat.posterior_mean(bins, keys, slots, np.eye(2, dtype=np.float32))
    weights = np.array([0.5 / 0.02**3, 1.0 / 0.06**3 * np.exp(-0.5 * (0.03 / 0.06) ** 2)])
    np.testing.assert_allclose(mean[0], weights / weights.sum(), rtol=1e-4)


def test_no_gaussians_give_no_blocks() -> None:
    bins, keys, alpha, _ = project(gaussians(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 4))))
    assert len(bins.packed) == len(keys) == len(alpha) == 0


def test_far_apart_and_negative_coordinates_cost_only_the_blocks_they_touch() -> None:
    g = gaussians([[-300.0, 5.0, 2.0], [400.0, -800.0, 1.0]], 0.03)
    _, keys, alpha, _ = project(g)
    assert len(keys) <= 16
    assert (alpha > 0.1).any(axis=1).sum() >= 2
