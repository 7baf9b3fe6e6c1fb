"""The projection against its plain reference and known answers."""

from dataclasses import replace

import numpy as np
import pytest
from scenes import gaussians, random_gaussians

from freeocc3d.core import voxel_keys
from freeocc3d.core.errors import ConfigError, DependencyError
from freeocc3d.core.transforms import quats_to_rotations
from freeocc3d.core.types import Gaussians
from freeocc3d.occupancy import splat, splat_reference, splat_torch
from freeocc3d.occupancy.gaussian_mass import POINTS, measure_boxes

V = 0.08
LOCAL = np.stack((np.arange(512) // 64, np.arange(512) // 8 % 8, np.arange(512) % 8), axis=1)


def project(g: Gaussians, origin=(0.0, 0.0, 0.0), least=0.0, **options):
    """Bins, block keys, probabilities (B, 512) and voxel centers (B * 512, 3). By default of the paper's projection."""
    origin = np.asarray(origin, float)
    chosen = splat.Options(voxel_size=V, **{"projection": "probabilistic", **options})
    bins = splat.bin_gaussians(g, origin, chosen, least_scale=least)
    keys = voxel_keys.unpack_voxels(bins.packed)
    centers = origin + ((keys[:, None] * 8 + LOCAL).reshape(-1, 3) + 0.5) * V
    return bins, keys, splat.compute_probability(bins, keys), centers


def alpha_at(g: Gaussians, point, **options) -> float:
    _, _, alpha, centers = project(g, **options)
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


def test_poisson_composes_by_opacity_as_its_equation_says() -> None:
    center = np.array([0.5, 0.5, 0.5]) * V
    means = np.stack((center - (0.03, 0, 0), center + (0.05, 0, 0)))
    a, b = np.exp(-0.5 * (0.03 / 0.04) ** 2), np.exp(-0.5 * (0.05 / 0.04) ** 2)
    two = gaussians(means, 0.04, opacities=(0.9, 0.7))
    assert alpha_at(two, center, projection="poisson") == pytest.approx(1 - np.exp(-0.9 * a - 0.7 * b), rel=1e-4)


def test_released_fills_the_box_around_a_gaussian_evenly() -> None:
    g = gaussians(np.array([0.1, 0.6, 0.4]) * V, 0.03, opacities=(0.999,))
    _, keys, alpha, _ = project(g, projection="released")
    filled = alpha.reshape(-1) > 0
    voxels = (keys[:, None] * 8 + LOCAL).reshape(-1, 3)[filled]
    np.testing.assert_array_equal(voxels.min(axis=0), (-2, -2, -2))  # ceil(3 * 0.03 / 0.08) = 2
    np.testing.assert_array_equal(voxels.max(axis=0), (2, 2, 2))
    assert len(voxels) == 125
    np.testing.assert_allclose(alpha.reshape(-1)[filled], 1 - np.exp(-0.999), rtol=1e-4)


@pytest.mark.parametrize("projection", ["probabilistic", "poisson"])
@pytest.mark.parametrize(("origin", "least"), [((0, 0, 0), 0.0), ((0.013, -0.021, 0.3), 0.0), ((0, 0, 0), 0.03)])
def test_probability_equals_the_reference_on_random_gaussians(origin, least, projection) -> None:
    g = random_gaussians(400, seed=1)
    _, _, alpha, centers = project(g, origin, least, projection=projection)
    expected = splat_reference.compute_probability_reference(g, centers, splat.Options(projection=projection), least)
    np.testing.assert_allclose(alpha.reshape(-1), expected, atol=2e-6)
    assert expected.max() > 0.6


def test_gaussians_finer_than_the_lattice_shows_are_widened_and_weighted_by_their_area() -> None:
    center = np.array([0.5, 0.5, 0.5]) * V
    g = gaussians(center, (0.02, 0.02, 0.06))
    beside = center + (V, 0, 0)
    assert alpha_at(g, beside) < 1e-6
    share = (0.02 / 0.04) ** (4 / 3)
    assert alpha_at(g, beside, least=0.04) == pytest.approx(share * np.exp(-0.5 * (V / 0.04) ** 2), rel=1e-3)
    for wide in (gaussians(center, 0.04), g[:0]):  # nothing is changed that is wide enough
        np.testing.assert_array_equal(project(wide)[2], project(wide, least=0.04)[2])
    for projection in ("integrated", "released"):
        np.testing.assert_array_equal(*(project(g, least=least, projection=projection)[2] for least in (0.0, 0.03)))


def test_what_the_cutoff_leaves_out_is_as_small_as_stated() -> None:
    g = random_gaussians(30, seed=2, extent=3.0)
    for projection, each in (("probabilistic", np.exp(-4.5)), ("integrated", 6 * 0.00135)):
        near, far = (project(g, cutoff=cutoff, projection=projection) for cutoff in (3.0, 6.0))
        whole = far[2][np.searchsorted(far[0].packed, near[0].packed)]
        assert 0 < np.abs(near[2] - whole).max() <= 1.0 - (1.0 - each) ** len(g)


def test_mass_within_voxels_is_near_quadrature() -> None:
    """Spheres, needles and sheets, from a tenth of a voxel to several."""
    rng = np.random.default_rng(7)
    g = random_gaussians(8, seed=7, extent=0.2)
    g.scales[:] = V * np.array([0.1, 0.3, 1.0, 2.0])[rng.integers(0, 4, (8, 3))]
    bins, keys, _, centers = project(g, projection="integrated")
    alpha = splat.compute_probability(replace(bins, share=np.ones(len(g), np.float32)), keys).reshape(-1)
    masses = splat_reference.measure_masses_reference(g, centers, splat.Options(voxel_size=V))
    difference = alpha - (1 - np.prod(1 - masses, axis=1))
    assert np.abs(difference).max() < 0.02
    assert np.sqrt((difference[alpha > 0] ** 2).mean()) < 0.004
    assert alpha.max() > 0.5


def test_the_spread_points_have_the_moments_of_the_normal_distribution() -> None:
    for count in (128, 256, 4096):
        np.testing.assert_allclose(POINTS[:count].mean(axis=0), 0, atol=1e-9)
        np.testing.assert_allclose(np.cov(POINTS[:count].T, bias=True), np.eye(3), atol=1e-9)


@pytest.mark.parametrize("flat", [(0.8, 0.8, 0.05), (0.05, 0.7, 0.8), (0.8, 0.05, 0.05)])
def test_mass_of_sheets_and_needles_at_any_angle_sums_to_one_and_stays_on_them(flat) -> None:
    mass, key, middle = np.zeros((8, 8, 8)), np.zeros(3, np.int32), np.full(3, 4.1, np.float32)
    for R in quats_to_rotations(random_gaussians(40, seed=9).quats_wxyz.astype(float)):
        S = R @ np.diag(np.array(flat) ** 2) @ R.T
        measure_boxes(middle, S[np.triu_indices(3)].astype(np.float32), 128, key, (0, 0, 0), (8, 8, 8), mass)
        assert mass.sum() == pytest.approx(1.0, abs=0.01)
        voxels = np.argwhere(mass) + 0.5 - middle
        across = np.abs(voxels @ R)
        assert (across <= 4.5 * np.array(flat) + 0.87).all()


def flat_grid(spacing: float, count: int) -> np.ndarray:
    """(count^2, 3) places around the origin, with z = 0."""
    x, y = np.meshgrid(*2 * (spacing * (np.arange(count) - count / 2),))
    return np.stack((x, y, 0 * x), axis=-1).reshape(-1, 3)


@pytest.mark.parametrize("tilt", [0.0, 0.3, 0.7])
def test_a_wall_of_discs_is_as_thick_as_the_voxels_that_it_crosses(tilt: float) -> None:
    """Whatever its place in the lattice: never three voxels, and one if it is parallel to a face."""
    spacing, place = 0.5 * V, flat_grid(0.5 * V, 40)
    c, s = np.cos(0.5 * tilt), np.sin(0.5 * tilt)
    R = quats_to_rotations(np.array([[c, 0, s, 0]]))[0]
    for offset in np.linspace(-0.45, 0.45, 7):
        means = place @ R.T + (0.003, 0.011, 0.5 * V + offset * V)
        g = gaussians(means, (0.7 * spacing, 0.7 * spacing, 0.002), np.tile((c, 0, s, 0), (len(means), 1)))
        _, keys, alpha, _ = project(g, projection="integrated")
        block, local = np.nonzero(alpha >= 0.5)
        voxels = keys[block] * 8 + LOCAL[local]
        voxels = voxels[(np.abs(voxels[:, :2]) < 5).all(axis=1)]  # away from the wall's rim
        columns, thickness = np.unique(voxels[:, :2], axis=0, return_counts=True)
        assert len(columns) == 81
        assert thickness.max() <= (1 if tilt == 0 else 2)


def test_finer_and_coarser_discs_make_the_same_surface() -> None:
    thin = []
    for spacing in (0.25 * V, 0.5 * V, V):
        g = gaussians(flat_grid(spacing, round(20 * V / spacing)) + 0.3 * V, (0.7 * spacing, 0.7 * spacing, 0.002))
        _, keys, alpha, _ = project(g, projection="integrated")
        voxels = (keys[:, None] * 8 + LOCAL).reshape(-1, 3)
        inner = (voxels[:, 2] == 0) & (np.abs(voxels[:, :2]) < 4).all(axis=1)
        thin.append(alpha.reshape(-1)[inner].mean())
        assert (alpha.reshape(-1)[inner] > 0.5).all()
    assert np.ptp(thin) < 0.05


def test_a_surface_is_even_up_to_the_voxel_in_which_it_ends() -> None:
    for offset in (0.0, 0.1, 0.25, 0.4):
        means = flat_grid(0.5 * V, 20) + (0.25 * V, (0.25 + offset) * V, 0.5 * V)  # x ends at the face x = 5 V
        g = gaussians(means, (0.35 * V, 0.35 * V, 0.002))
        _, keys, alpha, _ = project(g, projection="integrated")
        x, y, z = (keys[:, None] * 8 + LOCAL).reshape(-1, 3).T
        inner, beyond = ((z == 0) & (np.abs(y) < 3) & (x == place) for place in (3, 5))
        assert np.ptp(alpha.reshape(-1)[inner]) < 0.03
        assert 0 < alpha.reshape(-1)[beyond].max() < 0.33


def test_an_unknown_projection_is_refused_with_what_there_is() -> None:
    with pytest.raises(ConfigError, match="integrated, probabilistic, poisson"):
        splat.Options(projection="average")


def test_every_voxel_that_a_gaussian_reaches_lies_in_a_block() -> None:
    g = random_gaussians(50, seed=3)
    bins, keys, _, _ = project(g)
    around = np.unique(np.floor(g.means / (8 * V)).astype(int), axis=0)
    found = {tuple(key) for key in keys.tolist()}
    assert {tuple(key) for key in around.tolist()} <= found
    assert bins.start[-1] == len(bins.gaussian)
    assert (np.diff(bins.start) > 0).all()


@pytest.mark.parametrize("projection", ["probabilistic", "integrated"])
def test_posterior_mean_equals_the_reference(projection) -> None:
    g = random_gaussians(300 if projection == "probabilistic" else 20, seed=4)
    bins, keys, alpha, centers = project(g, projection=projection)
    wanted = alpha > 0.3
    slots = np.full(alpha.shape, -1, np.int32)
    slots[wanted] = np.arange(wanted.sum())
    values = np.random.default_rng(5).normal(size=(len(g), 9)).astype(np.float32)
    mean = splat.compute_posterior_mean(bins, keys, slots, values)
    options = splat.Options(projection=projection)
    expected = splat_reference.compute_posterior_mean_reference(g, centers[wanted.reshape(-1)], values, options)
    if projection == "probabilistic":
        np.testing.assert_allclose(mean, expected, atol=2e-5)
    else:  # masses are near those of quadrature
        assert np.abs(mean - expected).max() < 0.25
        assert np.sqrt(((mean - expected) ** 2).mean()) < 0.025


def test_values_of_half_precision_are_taken_as_they_are() -> None:
    g = random_gaussians(100, seed=4)
    bins, keys, alpha, _ = project(g)
    slots = np.where(alpha > 0.3, 0, -1).astype(np.int32)
    slots[slots == 0] = np.arange(np.count_nonzero(slots == 0))
    halves = np.random.default_rng(5).normal(size=(len(g), 9)).astype(np.float16)
    halves[:, :3] *= np.float16(1e-4)  # some without a whole mantissa
    halves[::7, 3] = -255
    expected = splat.compute_posterior_mean(bins, keys, slots, halves.astype(np.float32))
    np.testing.assert_allclose(splat.compute_posterior_mean(bins, keys, slots, halves), expected, rtol=1e-6)


def test_posterior_prefers_the_narrow_the_near_and_the_opaque() -> None:
    center = np.array([0.5, 0.5, 0.5]) * V
    g = gaussians([center, center + (0.03, 0, 0)], [[0.02] * 3, [0.06] * 3], opacities=(0.5, 1.0))
    bins, keys, alpha, centers = project(g)
    slots = np.full(alpha.shape, -1, np.int32)
    slots.reshape(-1)[np.linalg.norm(centers - center, axis=1).argmin()] = 0
    mean = splat.compute_posterior_mean(bins, keys, slots, np.eye(2, dtype=np.float32))
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


@pytest.mark.parametrize("projection", ["integrated", "probabilistic", "poisson", "released"])
@pytest.mark.parametrize("device", ["cpu:0", "cuda:0"])
def test_torch_projects_as_the_kernels_do(device: str, projection: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """On the processor as well: what differs on a GPU is the device only."""
    torch = pytest.importorskip("torch")
    if device == "cuda:0" and not torch.cuda.is_available():
        pytest.skip("needs a GPU")
    g = random_gaussians(200, seed=6)
    bins, keys, alpha, _ = project(g, (0.3, -1.2, 0.0), 0.03, projection=projection)
    there = replace(bins, device=device)
    monkeypatch.setattr(splat_torch, "_PAIRS", 1000)
    np.testing.assert_allclose(splat.compute_probability(there, keys), alpha, atol=3e-6)
    slots = np.full(alpha.shape, -1, np.int32)
    wanted = alpha > 0.3
    slots[wanted] = np.arange(wanted.sum())
    values = np.random.default_rng(5).normal(size=(len(g), 20)).astype(np.float32)
    np.testing.assert_allclose(
        splat.compute_posterior_mean(there, keys, slots, values),
        splat.compute_posterior_mean(bins, keys, slots, values),
        atol=3e-5,
    )


def test_a_gpu_that_is_not_there_is_reported() -> None:
    torch = pytest.importorskip("torch")
    with pytest.raises(ConfigError, match="cpu or cuda"):
        splat.check(splat.Options(device="gpu"))
    if not torch.cuda.is_available():
        with pytest.raises(DependencyError, match="needs a GPU"):
            splat.check(splat.Options(device="cuda:0"))
