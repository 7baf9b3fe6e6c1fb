"""Splats are sorted and listed as in NumPy, and composited as in plain torch."""

import os
import subprocess
import sys

import numpy as np
import pytest
import torch
from llvmlite import binding

from freeocc3d.gaussians.rasterizers.base import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN
from freeocc3d.gaussians.splat_projection import (
    COLUMNS,
    CONIC_A,
    CONIC_B,
    CONIC_C,
    OPACITY,
    PIXEL_U,
    PIXEL_V,
    RED,
    Z,
)
from freeocc3d.gaussians.tile_compositing import TILE, composite, composite_backward, list_by_tile, sort_nearest_first

COMPOSITED = """
import hashlib
import numpy as np
from freeocc3d.gaussians.tile_compositing import composite, composite_backward, list_by_tile
rng = np.random.default_rng(0)
splats = rng.uniform(0.02, 0.3, (200, 10)).astype(np.float32)
splats[:, :2], splats[:, 3] = rng.uniform(0, 60, (200, 2)), 0.01
first = np.clip(splats[:, :2] - 12, 0, 63).astype(np.int32)
last = np.clip(splats[:, :2] + 12, 0, 63).astype(np.int32)
box = np.stack((first[:, 0], last[:, 0], first[:, 1], last[:, 1]), axis=1)
start, listed, _, _ = list_by_tile(box, 4, 4)
out = composite(splats, box, start, listed, 64, 64)
gradient = np.cos(np.arange(out.size, dtype=np.float32)).reshape(out.shape)
found = composite_backward(splats, box, start, listed, out, gradient)
assert out.any() and found.any()
print(hashlib.sha256(out.tobytes() + found.tobytes()).hexdigest(), sum(composite.stats.cache_hits.values()))
"""
"""What a process composites, and whether it took its kernel from the cache."""


def test_splats_are_sorted_by_depth_and_ties_stay() -> None:
    z = np.random.default_rng(0).choice(np.linspace(0.02, 9, 40), 500).astype(np.float32)
    found = sort_nearest_first(np.arange(500), z.view(np.uint32))
    np.testing.assert_array_equal(found, np.argsort(z, kind="stable"))


def test_a_tile_lists_the_splats_whose_box_reaches_it() -> None:
    rng = np.random.default_rng(1)
    first = rng.integers(0, (5 * TILE, 3 * TILE), (60, 2))
    last = np.minimum(first + rng.integers(0, 2 * TILE, (60, 2)), (5 * TILE - 1, 3 * TILE - 1))
    box = np.stack((first[:, 0], last[:, 0], first[:, 1], last[:, 1]), axis=1).astype(np.int32)
    start, listed, first, places = list_by_tile(box, 5, 3)
    for tile in range(15):
        row, column = divmod(tile, 5)
        reached = (box[:, :2] // TILE - column, box[:, 2:] // TILE - row)
        inside = np.logical_and.reduce([(r[:, 0] <= 0) & (r[:, 1] >= 0) for r in reached])
        np.testing.assert_array_equal(listed[start[tile] : start[tile + 1]], np.flatnonzero(inside))
    for splat in range(60):
        own = places[first[splat] : first[splat + 1]]
        assert (listed[own] == splat).all()
        assert (np.diff(own) > 0).all()
    assert len(places) == first[-1] == start[-1]


WIDTH, HEIGHT = 37, 21
"""Three tiles by two, of which the last ones are cut off."""


def some_splats(seed: int) -> np.ndarray:
    """Nearest first: wide and narrow, faint and opaque ones, several of them opaque at the same place."""
    rng = np.random.default_rng(seed)
    splats = np.zeros((24, COLUMNS))
    splats[:, PIXEL_U], splats[:, PIXEL_V] = rng.uniform(-3, 40, 24), rng.uniform(-3, 24, 24)
    splats[8:14, PIXEL_U], splats[8:14, PIXEL_V] = rng.uniform(3, 5, 6), rng.uniform(3, 5, 6)
    for row, (deviations, angle) in enumerate(zip(rng.uniform(0.6, 6, (24, 2)), rng.uniform(0, 3, 24), strict=True)):
        R = np.array(((np.cos(angle), -np.sin(angle)), (np.sin(angle), np.cos(angle))))
        conic = R @ np.diag(1 / deviations**2) @ R.T
        splats[row, [CONIC_A, CONIC_B, CONIC_C]] = conic[0, 0], conic[0, 1], conic[1, 1]
    splats[:, OPACITY] = rng.uniform(0.05, 0.95, 24)
    splats[8:14, OPACITY] = 0.998
    splats[:, RED : RED + 3] = rng.uniform(0, 1, (24, 3))
    splats[:, Z] = np.sort(rng.uniform(1, 5, 24))
    return splats


def composite_plainly(splats: torch.Tensor) -> torch.Tensor:
    """(H, W, 5), splat by splat over the whole image."""
    v, u = torch.meshgrid(torch.arange(HEIGHT), torch.arange(WIDTH), indexing="ij")
    left, out = torch.ones((HEIGHT, WIDTH), dtype=torch.float64), torch.zeros((HEIGHT, WIDTH, 5), dtype=torch.float64)
    open_ = torch.ones((HEIGHT, WIDTH), dtype=torch.bool)
    for s in splats:
        du, dv = u - s[PIXEL_U], v - s[PIXEL_V]
        exponent = -0.5 * (s[CONIC_A] * du**2 + 2 * s[CONIC_B] * du * dv + s[CONIC_C] * dv**2)
        alpha = (s[OPACITY] * torch.exp(exponent)).clamp(max=ALPHA_MAX)
        shown = open_ & (alpha >= ALPHA_MIN)
        full = shown & (left * (1 - alpha) <= TRANSMITTANCE_MIN)
        open_ = open_ & ~full
        alpha = torch.where(shown & ~full, alpha, 0.0)
        values = torch.cat((s[RED : RED + 3], s[Z : Z + 1], torch.ones(1, dtype=torch.float64)))
        out = out + (alpha * left)[..., None] * values
        left = left * (1 - alpha)
    return out


@pytest.mark.parametrize("seed", range(2))
def test_pixels_and_gradients_are_those_of_a_plain_composition(seed: int) -> None:
    splats = some_splats(seed)
    box = np.tile(np.int32([0, WIDTH - 1, 0, HEIGHT - 1]), (24, 1))
    start, listed, first, places = list_by_tile(box, 3, 2)
    out = composite(np.float32(splats), box, start, listed, WIDTH, HEIGHT)
    exact = torch.from_numpy(splats).requires_grad_()
    expected = composite_plainly(exact)
    np.testing.assert_allclose(out, expected.detach().numpy(), atol=2e-5)
    assert out[4, 4, 4] > 0.998, "the opaque ones hide what is behind them"
    gradient = np.random.default_rng(seed).normal(size=out.shape)
    (expected * torch.from_numpy(gradient)).sum().backward()
    parts = composite_backward(np.float32(splats), box, start, listed, out, np.float32(gradient))
    found = np.stack([parts[places[first[s] : first[s + 1]]].astype(float).sum(axis=0) for s in range(24)])
    by_column = exact.grad.numpy()[:, [PIXEL_U, PIXEL_V, CONIC_A, CONIC_B, CONIC_C, OPACITY, RED, RED + 1, RED + 2, Z]]
    for column, (a, b) in enumerate(zip(found.T, by_column.T, strict=True)):
        assert np.linalg.norm(a - b) < 2e-3 * np.linalg.norm(b), column


def test_a_first_run_composites_as_later_ones_and_as_one_thread(tmp_path) -> None:
    found = []
    host = binding.get_host_cpu_name()  # no kernels that were compiled ahead of time
    for threads in ("2", "2", "1"):
        environment = os.environ | {
            "NUMBA_CACHE_DIR": str(tmp_path),
            "NUMBA_CPU_NAME": host,
            "OMP_NUM_THREADS": threads,
        }
        done = subprocess.run([sys.executable, "-c", COMPOSITED], env=environment, capture_output=True, check=True)
        found.append(done.stdout.split())
    assert [hits for _, hits in found] == [b"0", b"1", b"1"]
    assert len({content for content, _ in found}) == 1
