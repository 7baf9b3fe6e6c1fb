"""Rasterizers: the oracle against finite differences and analytic cases, the compiled one against the oracle."""

import sys
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from freeocc3d.core.errors import DependencyError
from freeocc3d.core.types import Intrinsics
from freeocc3d.gaussians.rasterizers import base, cpu, gsplat, reference

CAMERA = Intrinsics(45, 37, 40.0, 38.0, 21.7, 18.9)
NAMES = "means", "scales", "quats", "opacities", "colors"


def scene(n: int, seed: int = 0, dtype: torch.dtype = torch.float32):
    """Gaussians in front of, next to and behind a turned camera, of every size and opacity."""
    rng = np.random.default_rng(seed)
    arrays = (
        rng.uniform((-1.5, -1.5, -0.5), (1.5, 1.5, 3.5), (n, 3)),
        np.exp(rng.uniform(-4.5, -1.5, (n, 3))),
        rng.normal(size=(n, 4)) * 2,
        rng.uniform(0, 1, n),
        rng.uniform(0, 1, (n, 3)),
    )
    T = torch.eye(4, dtype=dtype)
    c, s = np.cos(0.3), np.sin(0.3)
    T[:3, :3] = torch.tensor(((c, 0, s), (0, 1, 0), (-s, 0, c)), dtype=dtype)
    T[:3, 3] = torch.tensor((0.1, -0.2, 0.4))
    return [torch.tensor(array, dtype=dtype) for array in arrays], T


def stacked(rendered: base.Rendered) -> torch.Tensor:
    return torch.cat((rendered.image, rendered.depth[..., None], rendered.alpha[..., None]), dim=2)


def with_gradients(rasterizer, arrays, T, weights, camera=CAMERA):
    leaves = [array.clone().requires_grad_() for array in arrays]
    out = stacked(rasterizer.render(base.Splats(*leaves), T, camera))
    (out * weights.to(out.dtype)).sum().backward()
    return out.detach(), [leaf.grad for leaf in leaves]


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("n", [1, 40, 1500])
def test_the_compiled_one_agrees_with_the_oracle(n: int, seed: int) -> None:
    arrays, T = scene(n, seed)
    weights = torch.tensor(np.random.default_rng(9).normal(size=(37, 45, 5)))
    exact = [array.double() for array in arrays]
    expected, gradients = with_gradients(reference.ReferenceRasterizer(), exact, T.double(), weights)
    out, found = with_gradients(cpu.load(), arrays, T, weights)
    torch.testing.assert_close(out.double(), expected, atol=1e-4 * float(expected.abs().max() + 1e-9), rtol=1e-4)
    for name, a, b in zip(NAMES, found, gradients, strict=True):
        assert (a - b).norm() <= 1e-4 * b.norm() + 1e-6, name


def test_the_oracles_gradients_are_finite_differences() -> None:
    arrays, T = scene(12, 3, torch.float64)
    arrays[3] = 0.3 + 0.5 * arrays[3]  # away from where alpha is cut off
    weights = torch.tensor(np.random.default_rng(2).normal(size=(37, 45, 5)))
    _, gradients = with_gradients(reference.ReferenceRasterizer(), arrays, T, weights)

    def value(changed) -> float:
        return float(
            (stacked(reference.ReferenceRasterizer().render(base.Splats(*changed), T, CAMERA)) * weights).sum()
        )

    rng = np.random.default_rng(4)
    for number, name in enumerate(NAMES):
        direction = torch.tensor(rng.normal(size=tuple(arrays[number].shape)))
        slopes = []
        for h in (1e-5, 1e-6, 1e-7):  # a pixel at the cut-off may flip within one of the steps
            ahead, behind = ([a.clone() for a in arrays] for _ in range(2))
            ahead[number] += h * direction
            behind[number] -= h * direction
            slopes.append((value(ahead) - value(behind)) / (2 * h))
        expected = float((gradients[number] * direction).sum())
        assert min(abs(slope - expected) for slope in slopes) <= 1e-4 * abs(expected) + 1e-6, name


@pytest.mark.parametrize("rasterizer", [reference.ReferenceRasterizer(), cpu.load()], ids=["reference", "cpu"])
def test_one_gaussian_on_the_axis_is_what_the_equations_say(rasterizer) -> None:
    camera = Intrinsics(21, 21, 50.0, 50.0, 10.0, 10.0)
    sigma, z, opacity = 0.05, 2.0, 0.8
    arrays = (
        torch.tensor([[0.0, 0.0, z]]),
        torch.full((1, 3), sigma),
        torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        torch.tensor([opacity]),
        torch.tensor([[0.2, 0.5, 0.9]]),
    )
    out = rasterizer.render(base.Splats(*arrays), torch.eye(4), camera)
    variance = (50.0 * sigma / z) ** 2 + base.BLUR
    squared = (np.arange(21) - 10.0)[:, None] ** 2 + (np.arange(21) - 10.0)[None] ** 2
    alpha = opacity * np.exp(-0.5 * squared / variance)
    alpha[alpha < base.ALPHA_MIN] = 0
    np.testing.assert_allclose(out.alpha.numpy(), alpha, atol=1e-6)
    np.testing.assert_allclose(out.depth.numpy(), z * alpha, atol=1e-5)
    np.testing.assert_allclose(out.image.numpy(), alpha[..., None] * np.float32((0.2, 0.5, 0.9)), atol=1e-6)


@pytest.mark.parametrize("rasterizer", [reference.ReferenceRasterizer(), cpu.load()], ids=["reference", "cpu"])
def test_the_nearer_of_two_hides_the_farther_by_its_alpha(rasterizer) -> None:
    camera = Intrinsics(5, 5, 50.0, 50.0, 2.0, 2.0)
    arrays = (
        torch.tensor([[0.0, 0.0, 3.0], [0.0, 0.0, 1.0]]),
        torch.full((2, 3), 0.5),
        torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(2, 1),
        torch.tensor([0.9, 0.6]),
        torch.tensor([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]),
    )
    out = rasterizer.render(base.Splats(*arrays), torch.eye(4), camera)
    np.testing.assert_allclose(out.image[2, 2].numpy(), (0.4 * 0.9, 0.6, 0.0), atol=1e-5)
    np.testing.assert_allclose(float(out.depth[2, 2]), 0.6 * 1.0 + 0.4 * 0.9 * 3.0, atol=1e-5)


@pytest.mark.parametrize("rasterizer", [reference.ReferenceRasterizer(), cpu.load()], ids=["reference", "cpu"])
def test_nothing_in_view_is_a_black_image_with_zero_gradients(rasterizer) -> None:
    arrays, _ = scene(20)
    arrays[0] = torch.tensor([[0.0, 0.0, -5.0]]).repeat(20, 1)
    out, gradients = with_gradients(rasterizer, arrays, torch.eye(4), torch.ones(37, 45, 5))
    assert not out.any()
    assert not any(gradient.any() for gradient in gradients)


def test_many_opaque_layers_and_tiny_or_huge_gaussians_stay_finite() -> None:
    n = 3000
    arrays, _ = scene(n, 5)
    arrays[0][:, 2] = torch.linspace(0.011, 4, n)  # down to the camera
    arrays[1][::3] = 1e-6
    arrays[1][1::3] = 50.0
    arrays[3][:] = 1.0
    out, gradients = with_gradients(cpu.load(), arrays, torch.eye(4), torch.ones(37, 45, 5))
    assert torch.isfinite(out).all()
    assert all(torch.isfinite(gradient).all() for gradient in gradients)
    assert float(out[..., 4].max()) <= 1.0 + 1e-5


def test_not_a_number_is_left_out() -> None:
    arrays, T = scene(50)
    expected = cpu.load().render(base.Splats(*arrays), T, CAMERA)
    broken = [torch.cat((array, torch.full_like(array[:1], torch.nan))) for array in arrays]
    out = cpu.load().render(base.Splats(*broken), T, CAMERA)
    torch.testing.assert_close(out.image, expected.image)


def test_gsplat_says_what_it_needs_where_there_is_no_gpu() -> None:
    if torch.cuda.is_available():
        pytest.skip("there is a GPU")
    with pytest.raises(DependencyError, match="NVIDIA GPU"):
        gsplat.load(gsplat.Options())


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_gsplat_and_the_reference_on_cuda_give_the_same_images() -> None:
    pytest.importorskip("gsplat")
    arrays, T = scene(1500)
    on_gpu = [array.cuda() for array in arrays]
    expected = stacked(reference.ReferenceRasterizer("cuda").render(base.Splats(*on_gpu), T.cuda(), CAMERA))
    out = stacked(gsplat.load(gsplat.Options()).render(base.Splats(*on_gpu), T.cuda(), CAMERA))
    # It bounds splats by whole pixels, so that a few at the very edge of alpha are left out.
    assert float((out - expected).abs().mean()) < 1e-3


def test_slopes_are_limited_to_fifteen_percent_beyond_each_edge_of_the_image() -> None:
    left, right, top, bottom = base.compute_slope_limits(CAMERA)
    u = np.array((left, right)) * CAMERA.fx + CAMERA.cx
    v = np.array((top, bottom)) * CAMERA.fy + CAMERA.cy
    np.testing.assert_allclose(u, (-0.5 - 0.15 * 45, 44.5 + 0.15 * 45))
    np.testing.assert_allclose(v, (-0.5 - 0.15 * 37, 36.5 + 0.15 * 37))


def test_gsplat_is_asked_for_its_pixel_centers_and_its_answer_is_taken_apart(monkeypatch) -> None:
    asked = {}

    def rasterization(**given):
        asked.update(given)
        out = torch.arange(37 * 45 * 4, dtype=torch.float32).reshape(1, 37, 45, 4)
        return out, torch.full((1, 37, 45, 1), 0.5), {}

    monkeypatch.setitem(sys.modules, "gsplat", SimpleNamespace(rasterization=rasterization))
    arrays, T = scene(3)
    found = gsplat.GsplatRasterizer("cpu").render(base.Splats(*arrays), T, CAMERA)
    expected = torch.arange(37 * 45 * 4, dtype=torch.float32).reshape(37, 45, 4)
    torch.testing.assert_close(found.image, expected[..., :3])
    torch.testing.assert_close(found.depth, expected[..., 3])
    torch.testing.assert_close(found.alpha, torch.full((37, 45), 0.5))
    torch.testing.assert_close(asked["Ks"], torch.tensor([[(40.0, 0.0, 22.2), (0.0, 38.0, 19.4), (0.0, 0.0, 1.0)]]))
    torch.testing.assert_close(asked["viewmats"], T[None])
    assert (asked["width"], asked["height"], asked["near_plane"], asked["eps2d"]) == (45, 37, 0.01, 0.3)
